"""Areas, classes, folds and rotations of Stanford2D3DS.

A pose (R, c) takes points of the room, in meters and with z up, to camera coordinates by
``x_cam = R (x − c)``; ``camera_rt_matrix`` in the pose file is ``[R | −R c]``. Camera axes are
x right, y down, z forward.

A panorama's pose is that of an upright camera facing the middle of the panorama. Its pixel
with sphere direction s (`tangent_train.geometry`: x to the middle, y right, z up) and distance d is
the room's point ``c + d Rᵀ (s_y, −s_z, s_x)``, which is ``c + d Rz(ψ) FLIP_Y s`` with the heading ψ
counterclockwise from the room's x axis. A perspective pixel (column j, row i) with z-depth d is
``c + d Rᵀ K⁻¹ (j, i, 1)`` with K for integer pixel centers.

Angles in pose files are XYZ Euler angles of Blender's camera, which faces −z with +y up:
``Rᵀ = Rz(c) Ry(b) Rx(a) BLENDER`` (as in the real set).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Area = Literal["1", "2", "3", "4", "5a", "5b", "6"]
AREAS: tuple[Area, ...] = get_args(Area)
"""All areas; 5a and 5b are parts of one floor and share rooms."""

CLASSES: tuple[str, ...] = (
    *("beam", "board", "bookcase", "ceiling", "chair", "clutter", "column"),
    *("door", "floor", "sofa", "table", "wall", "window"),
)
"""The 13 classes; the label of a class is its index plus one."""

EIGHT = ("ceiling", "chair", "door", "floor", "sofa", "table", "wall", "window")
"""The classes of the adaptation benchmarks SPin8, SPan8 and S3D8."""

THINGS = tuple(name for name in CLASSES if name not in ("ceiling", "clutter", "floor", "wall"))
"""Classes that have objects in a panoptic map."""

UNKNOWN_CLASS = "<UNK>"
"""Class of unlabeled instances."""

MISSING_LABEL = 0x0D0D0D
"""Instance of pixels without a label."""

MISSING_DEPTH = 65535
"""Depth of pixels without depth."""

FOLDS: dict[int, tuple[Area, ...]] = {1: ("5a", "5b"), 2: ("2", "4"), 3: ("1", "3", "6")}
"""Test areas of each fold; the other areas are for training."""

BLENDER = np.diag([1.0, -1.0, -1.0])
"""Axes of Blender's camera to x right, y down, z forward, and back."""

CAMERA_FROM_SPHERE = np.array([[0, 1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
"""A panorama's axes (x to the middle, y right, z up) to a camera's (x right, y down, z forward)."""
