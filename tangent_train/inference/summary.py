"""What predictions say about images: the share of every class, in a table."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.csv_text import csv_text
from tangent_train.files import write_text
from tangent_train.geometry import equirect_solid_angles

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["class_shares", "photo_solid_angles", "write_summary"]


def class_shares(
    labels: NDArray[np.integer], class_names: Sequence[str], camera_matrix: Any = None
) -> dict[str, float]:
    """Share of the solid angle of what is labelled that every class has.

    Args:
        labels: ``(H, W)``: of the whole sphere, or of a photo; 0 unknown.
        class_names: K + 1 names, the unknown class first.
        camera_matrix: ``(3, 3)`` K of a photo; None for panoramas.

    Returns:
        By name, without the unknown class; they add up to 1, or are all 0.
    """
    height, width = labels.shape
    count = len(class_names)
    total = np.zeros(count)
    by_row = equirect_solid_angles((height, width)) if camera_matrix is None else None
    for row in range(height):
        if by_row is not None:
            total += by_row[row] * np.bincount(labels[row], minlength=count)
        else:
            weights = photo_solid_angles(camera_matrix, row, width)
            total += np.bincount(labels[row], weights, minlength=count)
    known = total[1:].sum()
    shares = total[1:] / known if known > 0 else total[1:]
    return dict(zip(class_names[1:], map(float, shares), strict=True))


def photo_solid_angles(
    camera_matrix: NDArray[np.float64], row: int, width: int
) -> NDArray[np.float64]:
    """Steradians of the pixels of one row of a photo.

    A pixel of sides 1/f at (x, y) on the plane at distance 1 is seen at cos³ of its angle to the
    axis: ``1/(fx fy) · (1 + x² + y²)^(−3/2)``.

    Args:
        camera_matrix: ``(3, 3)`` K, integer pixel centres, without skew.
        row: Of the photo.
        width: Its columns.
    """
    (fx, _, cx), (_, fy, cy), _ = camera_matrix
    x, y = (np.arange(width) - cx) / fx, (row - cy) / fy
    angles: NDArray[np.float64] = (1 + x**2 + y**2) ** -1.5 / (fx * fy)
    return angles


def write_summary(folder: Path, content: dict[str, Any], class_names: Sequence[str]) -> None:
    """Write ``summary.json`` and ``summary.csv``, each atomically.

    Args:
        folder: Where to.
        content: Plain values; ``images`` lists the images, those that could be read with their
            ``classes``, see `class_shares`.
        class_names: K + 1 names.
    """
    write_text(folder / "summary.json", json.dumps(_plain(content), indent=1) + "\n")
    columns = ("file", "rows", "columns", "level", "views", "seam_ratio")
    rows = []
    for entry in content["images"]:
        shares = entry.get("classes", {})
        values = [entry.get(name) for name in columns]
        values += [shares.get(name) for name in class_names[1:]]
        rows.append([*map(_plain, values), entry.get("error")])
    table = csv_text([*columns, *class_names[1:], "error"], rows)
    write_text(folder / "summary.csv", table)


def _plain(value: Any) -> Any:
    """With None for what is not a number, which JSON does not know."""
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
