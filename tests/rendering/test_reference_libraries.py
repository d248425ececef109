"""Tangent images and cube maps against py360convert, a test-only dependency.

Its panorama pixels are as ours. A perspective image of n pixels spans its field of view from the
*centre* of the first pixel to the centre of the last: ``f = (n−1) / (2 tan(Ω/2))`` for width and
height each, principal point (n−1)/2. ``u_deg`` is yaw, to the right; ``v_deg`` is pitch, up. It
samples with OpenCV at positions rounded to 1/32 px. The faces of its cube maps span the 90° between
pixel *centres* too; their order is ours.
"""

from __future__ import annotations

import math

import numpy as np
import py360convert
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import CubeGrid, TangentGrid, xyz_to_lonlat
from tangent_train.rendering import equirect_to_tangent
from tests.rendering.reference import panorama_lonlat, to_xyz

SHAPE = (128, 256)
Image = NDArray[np.float32]


@pytest.fixture(scope="module")
def panorama() -> Image:
    """Smooth waves ``(H, W, 3)``, different in every direction."""
    x, y, z = np.moveaxis(to_xyz(panorama_lonlat(SHAPE)), -1, 0)
    channels = [np.sin(3 * x + y), np.cos(4 * y - z), x * y + np.sin(5 * z)]
    return np.stack(channels, axis=-1).astype(np.float32)


def one_64th_pixel(panorama: Image) -> float:
    """How much a value can change over 1/64 pixel each way: OpenCV's rounding of positions."""
    steps = [np.abs(np.diff(panorama, axis=axis)).max() for axis in (0, 1)]
    return float(sum(steps)) / 64


@pytest.mark.parametrize("base_level", [0, 1])
def test_tangent_images_are_perspective_views(panorama: Image, base_level: int) -> None:
    grid = TangentGrid(base_level, 6)
    size = (grid.dim, grid.dim)
    images = equirect_to_tangent(panorama, grid)
    width_deg = math.degrees(2 * math.atan(grid.half_extent))
    compared = 0
    for face, pose_deg in enumerate(np.degrees(xyz_to_lonlat(grid.centers_xyz))):
        if abs(pose_deg[0]) > 100 or abs(pose_deg[1]) > 30:
            continue  # their seam and poles
        theirs = py360convert.e2p(panorama, width_deg, *pose_deg, size)
        assert np.abs(images[face] - theirs).max() < one_64th_pixel(panorama) + 1e-5
        compared += 1
    assert compared >= 4


@pytest.mark.parametrize("dim", [16, 25])
def test_faces_of_a_cube_are_py360converts(panorama: Image, dim: int) -> None:
    # Their 2d + 1 pixel centres from edge to edge: every second one is one of our d.
    theirs = py360convert.e2c(panorama, 2 * dim + 1, cube_format="list")
    ours = equirect_to_tangent(panorama, CubeGrid(dim))
    for our_face, their_face in zip(ours, theirs, strict=True):
        error = np.abs(our_face - their_face[1::2, 1::2])
        assert error.max() < one_64th_pixel(panorama) + 1e-5
