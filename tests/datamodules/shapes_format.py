"""Meshes in the trees of ModelNet40, fabricated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from datamodules.synthshapes import make_shape

COUNTS = {"chair": (6, 2), "cup": (4, 3), "night_stand": (5, 1)}
"""Shapes of every class for training and for the test."""

_LIKE = {"night_stand": "table"}


def write_tree(
    root: Path,
    layout: Literal["by class", "by split"] = "by class",
    counts: Mapping[str, tuple[int, int]] = COUNTS,
) -> Path:
    """Write a small data set; returns its root."""
    for label, (train, test) in counts.items():
        for number in range(1, train + test + 1):
            part = "train" if number <= train else "test"
            name = f"{label}_{number:04d}.off"
            place = f"{label}/{part}" if layout == "by class" else f"modelnet40_{part}"
            path = root / place / name
            path.parent.mkdir(parents=True, exist_ok=True)
            make_shape(0, _LIKE.get(label, label), number).export(path)
    return root
