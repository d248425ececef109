"""Figures of the paper, and of the work it compares with: semantic segmentation on Stanford2D3DS.

Eder, Shvets, Lim and Frahm: Tangent Images for Mitigating Spherical Distortion, CVPR 2020
(arXiv:1912.09390): the table of semantic segmentation results, and the per-class table of the
supplement for RGB-D. All in percent, "averaged over the 3 folds".
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CLASSES", "SHAPE_DATA", "SHAPE_ROWS", "STANFORD_ROWS", "PaperRow", "paper_row"]

CLASSES = (
    "beam", "board", "bookcase", "ceiling", "chair", "clutter", "column",
    "door", "floor", "sofa", "table", "wall", "window",
)  # fmt: skip
"""The order of the per-class figures."""


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's tables, in percent.

    Attributes:
        method: Whose; "Ours" are the paper's own.
        level: s, the resolution of the input.
        base_level: b, of rivals the column as printed; "ERP" for equirectangular input.
        inputs: "RGB" or "RGB-D".
        macc: Mean class accuracy; None where none is printed.
        miou: Mean IoU; None where none is printed.
        accuracy: Of each class, see `CLASSES`; empty where none are printed.
        iou: Likewise.
    """

    method: str
    level: int
    base_level: int | str
    inputs: str
    macc: float | None
    miou: float | None
    accuracy: tuple[float, ...] = ()
    iou: tuple[float, ...] = ()


STANFORD_ROWS = (
    PaperRow("Cohen et al.", 5, 0, "RGB-D", 55.9, 39.4),
    PaperRow(
        "Jiang et al.", 5, 5, "RGB-D", 54.7, 38.3,
        (19.6, 48.6, 49.6, 93.6, 63.8, 43.1, 28.0, 63.2, 96.4, 21.0, 70.0, 74.6, 39.0),
        (8.7, 32.7, 33.4, 82.2, 42.0, 25.6, 10.1, 41.6, 87.0, 7.6, 41.7, 61.7, 23.5),
    ),
    PaperRow(
        "Zhang et al.", 5, 0, "RGB-D", 58.6, 43.3,
        (23.2, 56.5, 62.1, 94.6, 66.7, 41.5, 18.3, 64.5, 96.2, 41.1, 79.7, 77.2, 41.1),
        (10.9, 39.7, 37.2, 84.8, 50.5, 29.2, 11.5, 45.3, 92.9, 19.1, 49.1, 63.8, 29.4),
    ),
    PaperRow(
        "Ours", 5, 0, "RGB-D", 50.9, 38.3,
        (28.5, 39.3, 48.0, 85.8, 51.3, 54.2, 11.9, 63.5, 92.7, 16.6, 51.1, 77.5, 41.6),
        (9.0, 27.5, 34.7, 81.4, 38.4, 30.2, 5.2, 42.6, 89.2, 10.2, 42.0, 58.3, 29.5),
    ),
    PaperRow("Tateno et al.", 7, "ERP", "RGB", None, 34.6),
    PaperRow("Lee et al.", 7, 7, "RGB", 51.4, None),
    PaperRow(
        "Ours", 7, 0, "RGB-D", 59.1, 44.9,
        (30.4, 57.2, 56.8, 88.6, 72.7, 56.6, 18.4, 68.9, 95.2, 27.8, 57.9, 78.6, 58.6),
        (10.3, 41.3, 40.5, 84.8, 51.0, 40.0, 7.3, 47.2, 92.6, 16.0, 49.7, 66.0, 37.2),
    ),
    PaperRow("Ours", 10, 0, "RGB", 61.0, 44.3),
    PaperRow("Ours", 10, 1, "RGB", 65.2, 45.6),
    PaperRow("Ours", 10, 2, "RGB", 61.5, 42.7),
    PaperRow(
        "Ours", 10, 1, "RGB-D", 70.1, 52.5,
        (26.6, 76.6, 63.0, 90.2, 85.0, 62.5, 37.4, 72.0, 97.3, 67.5, 73.6, 78.6, 80.5),
        (6.0, 49.3, 49.7, 85.4, 71.7, 44.4, 16.0, 52.2, 94.5, 33.1, 62.1, 70.0, 48.5),
    ),
)  # fmt: skip


def paper_row(level: int, base_level: int, inputs: str) -> PaperRow | None:
    """The paper's own row for a resolution, a base level and inputs.

    >>> paper_row(10, 1, "RGB-D").miou
    52.5
    """
    for row in STANFORD_ROWS:
        if (row.method, row.level, row.base_level, row.inputs) == (
            "Ours", level, base_level, inputs,
        ):  # fmt: skip
            return row
    return None


SHAPE_DATA = "datamodules.ModelNet40"
"""The data set of the paper's shape classification."""

SHAPE_ROWS = (
    ("Cohen et al.", 85.0),
    ("Esteves et al.", 88.9),
    ("Jiang et al.", 90.5),
    ("tangent images", 89.1),
)
"""Accuracy in percent: the paper's table "classification results". It says nothing of rotations;
the released code trains and tests on shapes that stand upright and are not turned."""
