"""The figure: what lies where, against lines and planes intersected by hand."""

from __future__ import annotations

import io
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, equirect_directions, random_rotation
from tangent_train.rendering import figure, figure_views
from tangent_train.rendering.figure import tangent_figure
from tangent_train.rendering.figure_views import from_inside, inside_positions, with_borders

SIZE = (160, 90)


def _directions_as_colors(height: int) -> NDArray[np.uint8]:
    """``(H, 2H, 3)``: −1 to 1 along x, y and z as 0 to 255."""
    return np.rint((equirect_directions((height, 2 * height)) + 1) * 127.5).astype(np.uint8)


def _figure(panorama: NDArray[Any], grid: TangentGrid) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(tangent_figure(panorama, grid))) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


@pytest.mark.parametrize("base_level", [0, 1])
def test_parts_are_in_their_places(base_level: int) -> None:
    grid = TangentGrid(base_level, 5)
    panorama = _directions_as_colors(64)
    page = _figure(panorama, grid)
    assert page.shape[1] == 1920
    assert 800 < page.shape[0] < 1000
    left, top = figure._MARGIN, figure._MARGIN + figure._CAPTION
    for row, column in ((70, 110), (200, 300), (300, 650)):  # off lines and numbers
        shown = page[top + row, left + column].astype(int)
        there = panorama[row * 64 // 370, column * 128 // 740]
        assert np.abs(shown - there).max() < 12
    montage = figure._montage(grid)
    edge = 6
    colors = grid.directions()[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    for (x, y), corners in zip(montage.corners, colors, strict=True):
        part = page[top + y :, x:][: montage.side, : montage.side].astype(int)
        shown = part[[edge, edge, -edge, -edge], [edge, -edge, edge, -edge]]
        assert np.abs(shown - (corners + 1) * 127.5).max() < 25


def test_grey_of_16_bits() -> None:
    grid = TangentGrid(0, 4)
    page = _figure(np.full((32, 64), 100 * 257, np.uint16), grid)
    corner = figure._montage(grid).corners[0]
    x, y = corner[0] + 5, corner[1] + 5 + figure._MARGIN + figure._CAPTION
    assert page[y, x].tolist() == [100, 100, 100]
    grey = np.arange(8, dtype=np.uint8).reshape(2, 4)
    assert figure._colors(grey)[1, 2].tolist() == [6, 6, 6]


@pytest.mark.parametrize("base_level", range(4))
def test_the_montage_shows_every_image_once_from_north_to_south(base_level: int) -> None:
    grid = TangentGrid(
        base_level, base_level + 4, rotation=random_rotation(np.random.default_rng(base_level))
    )
    rows = figure._rows(grid)
    assert sorted(face for row in rows for face in row) == list(range(grid.num_images))
    assert {len(row) for row in rows} == {5 * 2**base_level}
    x, y, z = grid.with_rotation(None).centers_xyz.T
    for row in rows:
        assert (np.diff(np.arctan2(y, x)[row]) >= -1e-6).all()
    for upper, lower in pairwise(rows):
        assert z[upper].min() >= z[lower].max() - 1e-6
    montage = figure._montage(grid)
    assert montage.side > 0
    boxes = {(x, y) for x, y in montage.corners.tolist()}
    assert len(boxes) == grid.num_images
    columns = np.unique(montage.corners[:, 0])
    if base_level:
        assert np.diff(columns).min() > montage.side
    assert montage.corners.max(axis=0)[0] + montage.side <= 1920 - figure._MARGIN + 1


def test_the_view_from_inside_is_that_of_planes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays cut with every plane, one after the other, in float64."""
    monkeypatch.setattr(figure_views, "_SHADE", 0.0)
    monkeypatch.setattr(figure_views, "_LINES", 0.0)
    grid = TangentGrid(1, 6, rotation=random_rotation(np.random.default_rng(0)))
    view = from_inside(_directions_as_colors(512), grid, SIZE)
    assert view.shape == (*SIZE[::-1], 3)
    eye = figure_views._EYE
    focal = SIZE[0] / 2 / math.tan(math.radians(figure_views._FOV_DEG / 2))
    for row, column in ((0, 0), (20, 100), (45, 80), (89, 159), (60, 31)):
        right, down = column + 0.5 - SIZE[0] / 2, row + 0.5 - SIZE[1] / 2
        ray = np.array([focal, right, -down])
        ahead = [normal for normal in grid.centers_xyz if normal @ ray > 0]
        times = [(1 - normal @ eye) / (normal @ ray) for normal in ahead]
        point = eye + min(times) * ray
        expected = (point / np.linalg.norm(point) + 1) * 127.5
        assert np.abs(view[row, column] - expected).max() < 3
        (position,) = inside_positions(point[None], SIZE)
        np.testing.assert_allclose(position, (column + 0.5, row + 0.5))
    assert np.isnan(inside_positions(np.array([[-1.0, 0, 0]]), SIZE)).all()


def test_planes_seen_from_the_side_are_darker() -> None:
    white = np.full((32, 64, 3), 255, np.uint8)
    view = from_inside(white, TangentGrid(0, 4), SIZE)
    assert view.min() >= 255 * (1 - figure_views._SHADE) - 1
    assert len(np.unique(view)) > 20


def test_borders_are_where_the_owner_changes() -> None:
    finer = figure_views.FINER
    image = np.zeros((10, 20, 3), np.uint8)
    owners = np.zeros((10 * finer, 20 * finer), np.int64)
    assert not with_borders(image, owners).any()
    owners[:, 8 * finer :] = 1
    lined = with_borders(image, owners)
    columns = np.flatnonzero(lined[..., 0].any(axis=0))
    assert set(columns) <= {7, 8}
    per_row = lined[5, :, 0].sum() / 255
    assert per_row == pytest.approx(figure_views._LINES, abs=0.02)


@pytest.mark.parametrize(
    ("panorama", "base_level", "message"),
    [
        (np.zeros((32, 64), np.float32), 0, "grey or colours"),
        (np.zeros((32, 64, 4), np.uint8), 0, "grey or colours"),
        (np.zeros((32, 64), np.uint8), 4, "at most 3"),
    ],
)
def test_errors(panorama: NDArray[Any], base_level: int, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        tangent_figure(panorama, TangentGrid(base_level, base_level + 4))
