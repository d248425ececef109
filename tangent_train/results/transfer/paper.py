"""Figures of the paper's network transfer, on Stanford2D3DS and on OmniSYNTHIA.

As `reports.paper`: the table of transfer results by fold, the comparison with Zhang et al., and the
per-class table of the supplement. All in percent. The table's rows for all folds repeat those of
fold 3 digit for digit; the means of the printed folds are what the per-class table's means are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

__all__ = [
    "SYNTHIA_ROWS",
    "TRANSFER_SETTING",
    "TRANSFER_STAGES",
    "PaperStage",
    "SynthiaRow",
    "paper_stage",
    "synthia_row",
]

TRANSFER_SETTING = {"level": 8, "base_level": 1, "inputs": "RGB-D"}
"""What the paper's transfer on Stanford2D3DS was run with."""


@dataclass(frozen=True)
class PaperStage:
    """A stage on Stanford2D3DS, in percent.

    Attributes:
        name: The paper's.
        on: What the network was tested on; photos of side 128, panoramas of level 8.
        epochs: Of fine-tuning.
        macc: Mean class accuracy of folds 1, 2 and 3.
        miou: Mean IoU, likewise.
        accuracy: Of each class, see `reports.paper.CLASSES`, over all folds; empty if not printed.
        iou: Likewise.
    """

    name: str
    on: Literal["photos", "panoramas"]
    epochs: int
    macc: tuple[float, float, float]
    miou: tuple[float, float, float]
    accuracy: tuple[float, ...] = ()
    iou: tuple[float, ...] = ()

    @property
    def partner(self) -> PaperStage | None:
        """The photos' stage with as much fine-tuning; None for photos."""
        if self.on == "photos":
            return None
        return next(s for s in TRANSFER_STAGES if s.on == "photos" and s.epochs == self.epochs)

    def figure(self, name: str, folds: Sequence[int | None]) -> float | None:
        """The mean of "macc" or "miou" over folds; None for another figure or an unknown fold.

        >>> round(paper_stage("S").figure("miou", [1, 2, 3]), 1)
        42.3
        """
        of_folds = {"macc": self.macc, "miou": self.miou}.get(name)
        known = [fold for fold in folds if fold in {1, 2, 3}]
        if of_folds is None or not known or len(known) < len(folds):
            return None
        return fmean(of_folds[fold - 1] for fold in known if fold is not None)


TRANSFER_STAGES = (
    PaperStage(
        "P", "photos", 0, (61.7, 57.8, 65.9), (47.4, 38.6, 51.1),
        (28.0, 71.6, 66.5, 88.0, 66.7, 57.4, 21.1, 60.2, 90.0, 36.3, 75.7, 77.9, 64.1),
        (8.6, 50.5, 45.5, 72.6, 50.1, 36.8, 11.5, 49.0, 82.0, 22.2, 50.5, 64.6, 50.1),
    ),
    PaperStage(
        "S", "panoramas", 0, (60.2, 47.8, 64.2), (45.3, 34.4, 47.3),
        (22.9, 57.1, 53.5, 88.8, 66.6, 45.9, 24.5, 67.1, 94.8, 36.2, 54.9, 72.4, 61.7),
        (8.4, 48.1, 42.5, 73.1, 50.3, 34.3, 9.9, 43.2, 71.3, 23.3, 46.2, 60.0, 39.7),
    ),
    PaperStage("P-FT-1", "photos", 1, (60.9, 56.4, 66.0), (48.4, 39.6, 51.5)),
    PaperStage("S-FT-1", "panoramas", 1, (62.5, 52.6, 68.4), (48.4, 40.6, 51.9)),
    PaperStage(
        "P-FT-10", "photos", 10, (60.6, 56.7, 65.6), (48.9, 40.8, 51.7),
        (15.3, 68.9, 65.8, 89.3, 67.7, 61.1, 14.7, 58.3, 91.3, 41.1, 73.7, 82.7, 62.7),
        (6.7, 56.2, 47.0, 73.6, 51.2, 38.4, 10.0, 48.9, 84.0, 24.9, 53.7, 66.5, 51.6),
    ),
    PaperStage(
        "S-FT-10", "panoramas", 10, (66.0, 55.6, 70.3), (50.6, 43.6, 54.6),
        (28.1, 65.3, 63.0, 87.8, 73.8, 56.2, 25.3, 75.9, 94.1, 50.1, 63.3, 81.9, 67.0),
        (10.8, 54.3, 49.2, 83.9, 57.9, 39.4, 10.2, 51.3, 90.5, 30.5, 53.8, 68.1, 45.0),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class SynthiaRow:
    """A row on OmniSYNTHIA, in percent.

    Attributes:
        level: s of the panoramas.
        method: Whose; "Ours" are the paper's own, base level 1.
        training: "no FT", "FT-10" (10 epochs on panoramas), or "native" (on panoramas alone).
        macc: Mean class accuracy.
        miou: Mean IoU.
    """

    level: int
    method: str
    training: Literal["no FT", "FT-10", "native"]
    macc: float
    miou: float


SYNTHIA_ROWS = (
    SynthiaRow(6, "Ours", "no FT", 55.2, 43.2),
    SynthiaRow(6, "Ours", "FT-10", 59.4, 46.1),
    SynthiaRow(6, "Zhang et al.", "FT-10", 44.8, 36.7),
    SynthiaRow(6, "Zhang et al.", "native", 52.2, 43.6),
    SynthiaRow(7, "Ours", "no FT", 60.2, 44.9),
    SynthiaRow(7, "Ours", "FT-10", 65.3, 50.2),
    SynthiaRow(7, "Zhang et al.", "FT-10", 47.2, 38.0),
    SynthiaRow(7, "Zhang et al.", "native", 57.1, 48.3),
    SynthiaRow(8, "Ours", "no FT", 70.8, 54.9),
    SynthiaRow(8, "Ours", "FT-10", 73.2, 55.7),
    SynthiaRow(8, "Zhang et al.", "FT-10", 52.8, 45.3),
    SynthiaRow(8, "Zhang et al.", "native", 55.1, 47.1),
)


def paper_stage(name: str) -> PaperStage | None:
    """The paper's stage of a name on Stanford2D3DS; None for other names."""
    return next((stage for stage in TRANSFER_STAGES if stage.name == name), None)


def synthia_row(level: int, name: str) -> SynthiaRow | None:
    """The paper's own row on OmniSYNTHIA for a level and a stage's name.

    >>> synthia_row(7, "S-FT-10").miou
    50.2
    """
    training = {"S": "no FT", "S-FT-10": "FT-10"}.get(name)
    for row in SYNTHIA_ROWS:
        if (row.method, row.level, row.training) == ("Ours", level, training):
            return row
    return None
