"""Perspective cameras against the equations of the paper's supplement, section 2.1.

The paper counts pixels from the corner of the image (c' = W'/2); here they are counted from the
center of the first pixel, so that ``c_paper = c + ½``.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    camera_matrix_from_fov,
    perspective_directions,
    ray_lengths,
    shift_range,
)

SIZE = (480, 760)  # height, width: not square, mistake 5 of the released code swaps them
K = np.array([[560.0, 0, 370.25], [0, 520.0, 244.0], [0, 0, 1]])
CORNER = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
"""Converts pixels counted from centers to pixels counted from corners."""


def paper_shift_range(
    matrix: NDArray[np.float64], size: tuple[int, int], fov_deg: float, dim: int
) -> NDArray[np.float64]:
    """Least and greatest (δx, δy), the supplement's last formula, in its own pixels."""
    (f_x, _, c_x), (_, f_y, c_y), _ = CORNER @ matrix
    height, width = size
    focal = dim / (2 * math.tan(math.radians(fov_deg) / 2))
    center = dim / 2
    return np.array([
        [f_x / focal * center - c_x, f_y / focal * center - c_y],
        [width - c_x - f_x / focal * (dim - center), height - c_y - f_y / focal * (dim - center)],
    ])  # fmt: skip


@given(
    focal=st.tuples(st.floats(300, 900), st.floats(300, 900)),
    size=st.tuples(st.integers(400, 800), st.integers(400, 800)),
    off_center=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    fov_deg=st.floats(5, 24),
    dim=st.integers(8, 256),
)
def test_shift_range_is_the_papers(
    focal: tuple[float, float],
    size: tuple[int, int],
    off_center: tuple[float, float],
    fov_deg: float,
    dim: int,
) -> None:
    height, width = size
    matrix = np.array([
        [focal[0], 0, width / 2 + off_center[0]], [0, focal[1], height / 2 + off_center[1]],
        [0, 0, 1],
    ])  # fmt: skip
    expected = paper_shift_range(matrix, size, fov_deg, dim)
    np.testing.assert_allclose(shift_range(matrix, size, fov_deg, (9, 9)), expected, atol=1e-9)


@pytest.mark.parametrize("fov_deg", [0.5, 45.0, 150.0])
@pytest.mark.parametrize("size", [(4, 6), (11, 7)])
def test_fov_is_between_the_outer_pixel_edges(fov_deg: float, size: tuple[int, int]) -> None:
    matrix = camera_matrix_from_fov(fov_deg, size)
    height, width = size
    edges = np.array([[-0.5, (height - 1) / 2, 1], [width - 0.5, (height - 1) / 2, 1]])
    left, right = edges @ np.linalg.inv(matrix).T
    cosine = left @ right / np.linalg.norm(left) / np.linalg.norm(right)
    assert math.degrees(math.acos(cosine)) == pytest.approx(fov_deg, abs=1e-9)
    assert left[1] == pytest.approx(0)  # the middle row looks neither up nor down
    assert matrix[0, 0] == matrix[1, 1]


def test_perspective_directions_project_to_their_pixel() -> None:
    directions = perspective_directions(K, SIZE)
    assert directions.shape == (*SIZE, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    pixels = directions @ K.T
    pixels = pixels[..., :2] / pixels[..., 2:]
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-9)
    assert (directions[-1, -1] > 0).all()  # x right, y down, z forward
    np.testing.assert_allclose(ray_lengths(K, SIZE), 1 / directions[..., 2])


def test_an_image_too_small_is_refused() -> None:
    matrix = K.copy()
    matrix[:2, 2] = 760 / 2, 300 / 2
    expected = r"field of view: found \[45.0, 45.0\]° for an image that spans \[68.32, 32.18\]°;"
    with pytest.raises(SettingError, match=expected):
        shift_range(matrix, (300, 760), 45, (128, 128))
