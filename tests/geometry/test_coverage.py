"""The views of partial panoramas, beside slow tests of every pixel."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, random_rotation
from tangent_train.geometry.coverage import best_views, is_valid
from tangent_train.geometry.sphere import area_mask
from tangent_train.rendering import (
    CubemapRepresentation,
    EquirectRepresentation,
    HorizontalRepresentation,
    TangentRepresentation,
    rotate_equirect,
)

STRIP = (-180, 180, -35.15, 35.15)
ANGLES = [STRIP, (-136, -59, 12, 74), (130, -150, -90, 30), (6, 40, -79, 8), (-3, 3, -2, 2)]
RINGS: Any = [{"pitch": 0, "views": 8}, {"pitch": 40, "views": 5}, {"pitch": -40, "views": 5}]
WIDE: Any = [{"pitch": 0, "views": 6}, *({"pitch": p, "views": 5, "fov": 120} for p in (50, -50))]
SHAPE = (128, 256)

VIEWS: dict[str, Any] = {
    "tangent, b = 0": TangentRepresentation(0, 6),
    "tangent, b = 1": TangentRepresentation(1, 6),
    "nearest": TangentRepresentation(1, 6, blend="nearest"),
    "cropped": TangentRepresentation(0, 6, crop_multiple=2, blend="nearest"),
    "horizontal": HorizontalRepresentation(6, RINGS, [100, 100]),
    "cube map": CubemapRepresentation(6),
    "rings of two widths": HorizontalRepresentation(6, WIDE, 100),
    "two levels": TangentRepresentation(0, 6, levels=[6, 5], rotations=2),
}


def _valid(angles: tuple[float, ...], seed: int | None = None) -> NDArray[np.bool_]:
    valid = area_mask(angles, SHAPE)
    if seed is None:
        return valid
    rotation = random_rotation(np.random.default_rng(seed))
    return rotate_equirect(valid.astype(np.uint8), rotation, "nearest") > 0


@pytest.mark.parametrize(
    ("name", "of_all"),
    {
        "tangent, b = 0": (10, 20),
        "tangent, b = 1": (40, 80),
        "cropped": (10, 20),
        "horizontal": (8, 18),
        "cube map": (4, 6),
        "rings of two widths": (6, 16),
    }.items(),
)
def test_a_strip_of_70_degrees_needs_about_half_of_the_views(
    name: str, of_all: tuple[int, int]
) -> None:
    counts = [sum(map(len, VIEWS[name].view_sets(valid))) for valid in (_valid(STRIP), None)]
    assert tuple(counts) == of_all
    assert len(VIEWS[name].sample(np.random.default_rng(0), _valid(STRIP))) == of_all[0]


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize(("angles", "seed"), [(ANGLES[0], 0), *((a, None) for a in ANGLES[1:])])
def test_views_see_every_valid_pixel(
    name: str, angles: tuple[float, ...], seed: int | None
) -> None:
    valid, views = _valid(angles, seed), VIEWS[name]
    if seed is not None:
        views = views.with_rotation(random_rotation(np.random.default_rng(1)))
    sets = views.view_sets(valid)
    assert sum(map(len, sets)) <= sum(map(len, views.view_sets())) - (seed is None)
    shown = [_shown(views, of_set, valid) for of_set in sets]
    assert np.all(np.any(shown, axis=0) if name == "rings of two widths" else shown)


def _shown(views: Any, of_set: Any, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return ``(n,)`` True for the valid pixels that a set of views shows where they are needed."""
    directions, grid = equirect_directions(valid.shape)[valid], of_set.grid
    seen = grid.widened(1).insets(directions).T >= -1e-9
    if views.blend == "nearest" or not grid.is_overlapping:
        seen = np.take_along_axis(seen, grid.owners(directions)[:, None], axis=1)
    shown: NDArray[np.bool_] = seen.any(axis=1)
    return shown


@pytest.mark.parametrize("blend", ["feather", "nearest"])
def test_views_of_an_area_with_many_rows_see_every_pixel(blend: Any) -> None:
    """Views are chosen by cells of 1°, the pixels of these views have 0.2°."""
    valid = area_mask((135.6, -53.1, -41.8, 36.0), (720, 1440))
    views = TangentRepresentation(0, 9, blend=blend)
    assert _shown(views, views.view_sets(valid)[0], valid).all()


def test_the_best_views_see_most_of_the_area_by_solid_angle() -> None:
    """A meridian strip has as many pixels at the pole as at the equator."""
    valid = area_mask((-30, 30, -10, 90), (60, 120))
    grid = TangentRepresentation(1, 6).grid
    turns, heights = np.random.default_rng(0).uniform(-1, 1, (2, 400_000))
    flat = np.sqrt(1 - heights**2)
    points = np.stack(
        [flat * np.cos(np.pi * turns), flat * np.sin(np.pi * turns), heights], axis=-1
    )
    seen = (grid.insets(points[is_valid(valid, points)]) >= 0).sum(axis=1)
    for count in (1, 3, 6):
        assert seen[best_views(grid, valid, count)].sum() > 0.97 * np.sort(seen)[-count:].sum()


@pytest.mark.parametrize(("rotation", "up"), [("none", 0), ("yaw", None), ("so3", 0)])
@pytest.mark.parametrize("kind", ["tangent", "few", "crops", "joint"])
def test_training_samples_have_one_size(rotation: Any, up: int | None, kind: str) -> None:
    """Under every rotation; they see more valid pixels than a random choice does."""
    valid = _valid((-100, 60, -20, 40))
    image = valid.astype(np.uint8)
    built: dict[str, Any] = {
        "tangent": TangentRepresentation(0, 6, random_rotation=rotation),
        "few": TangentRepresentation(0, 6, random_rotation=rotation, faces_per_panorama=3),
        "crops": EquirectRepresentation(6, random_rotation=rotation, crop_deg=90),
        "joint": copy.copy(VIEWS["rings of two widths"]),
    }
    built["joint"].random_rotation = rotation
    views = built[kind]
    if up is not None:
        views = views.with_rotation(random_rotation(np.random.default_rng(up)))
    shapes, seen = set(), []
    for given in (valid, None):
        shown = [
            views.sample(np.random.default_rng(seed), given).render(image, "nearest")
            for seed in range(12)
        ]
        if given is not None:
            shapes = {view.shape for view in shown}
        seen.append(np.mean([view.mean() for view in shown]))
    assert len(shapes) == 1
    assert seen[0] > 1.2 * seen[1] or (kind == "crops" and (up is not None or rotation == "so3"))
    if kind == "few":
        assert shapes == {(3, 64, 64)}


def test_horizontal_views_of_an_area_are_refused_for_more_than_that() -> None:
    row = HorizontalRepresentation(6, RINGS[:1], [100, 100], area=STRIP)
    assert len(row.view_sets(_valid(STRIP))[0]) == 8
    for valid in (None, _valid((-180, 180, -60, 30)), _valid(STRIP, 0)):
        with pytest.raises(SettingError, match=r"8 views that miss .* the (area|sphere)"):
            row.view_sets(valid)
