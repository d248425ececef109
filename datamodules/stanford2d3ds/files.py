"""Areas, classes and folds of Stanford2D3DS; SynthRooms needs only these."""

from __future__ import annotations

AREAS: tuple[str, ...] = ("1", "2", "3", "4", "5a", "5b", "6")
"""All areas; 5a and 5b are parts of one floor and share rooms."""

CLASSES: tuple[str, ...] = (
    "beam",
    "board",
    "bookcase",
    "ceiling",
    "chair",
    "clutter",
    "column",
    "door",
    "floor",
    "sofa",
    "table",
    "wall",
    "window",
)
"""The 13 classes; the label of a class is its index plus one."""

EIGHT: tuple[str, ...] = (
    *("ceiling", "chair", "door", "floor", "sofa", "table", "wall", "window"),
)
"""The classes of the adaptation benchmarks SPin8, SPan8 and S3D8."""

UNKNOWN_CLASS = "<UNK>"
"""Class of unlabeled instances."""

MISSING_LABEL = 0x0D0D0D
"""Instance of pixels without a label."""

MISSING_DEPTH = 65535
"""Depth of pixels without depth."""

FOLDS: dict[int, tuple[str, ...]] = {1: ("5a", "5b"), 2: ("2", "4"), 3: ("1", "3", "6")}
"""Test areas of each fold; the other areas are for training."""
