"""Representations that are limited to an area of the sphere."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    SphereArea,
    equirect_directions,
    random_rotation,
    rotation_about,
)
from tangent_train.rendering import (
    CubemapRepresentation,
    EquirectRepresentation,
    HorizontalRepresentation,
    TangentRepresentation,
)

STRIP = (-180, 180, -35.15, 35.15)
ANGLES = [STRIP, (-40, 40, -20, 50), (130, -150, -90, 30), (-3, 3, -2, 2)]
RINGS: Any = [{"pitch": 0, "views": 8}, {"pitch": 40, "views": 5}, {"pitch": -40, "views": 5}]
SHAPE = (128, 256)

TANGENT: dict[str, Any] = {
    "tangent, b = 0": TangentRepresentation(0, 6),
    "tangent, b = 1": TangentRepresentation(1, 6),
    "cropped": TangentRepresentation(0, 6, crop_multiple=2, blend="nearest"),
    "horizontal": HorizontalRepresentation(6, RINGS, [100, 100]),
    "cube map": CubemapRepresentation(6),
    "rings of two widths": HorizontalRepresentation(
        6,
        [{"pitch": 0, "views": 6}, *({"pitch": p, "views": 3, "fov": 120} for p in (50, -50))],
        100,
    ),
    "two levels": TangentRepresentation(0, 6, levels=[6, 5], rotations=2),
}


def _rotations(seed: int | None) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    if seed is None:
        return None, np.eye(3)
    rng = np.random.default_rng(seed)
    return random_rotation(rng), random_rotation(rng)


@pytest.mark.parametrize(
    ("name", "of_all"),
    {
        "tangent, b = 0": (10, 20),
        "tangent, b = 1": (40, 80),
        "cropped": (10, 20),
        "horizontal": (8, 18),
        "cube map": (4, 6),
    }.items(),
)
def test_a_strip_of_70_degrees_needs_about_half_of_the_views(
    name: str, of_all: tuple[int, int]
) -> None:
    views = TANGENT[name].limited_to(SphereArea.of(STRIP))
    assert (len(views.view_sets()[0]), len(TANGENT[name].view_sets()[0])) == of_all
    assert len(views.sample(np.random.default_rng(0))) == of_all[0]


@pytest.mark.parametrize("name", TANGENT)
@pytest.mark.parametrize("angles", ANGLES)
@pytest.mark.parametrize("seed", [None, 0])
def test_the_views_cover_the_area(name: str, angles: tuple[float, ...], seed: int | None) -> None:
    """At every pixel of the panorama, in rotated frames of the views and of the area."""
    of_area, of_views = _rotations(seed)
    area = SphereArea.of(angles).rotated(of_area)
    limited = TANGENT[name].with_rotation(of_views).limited_to(area)
    directions = equirect_directions(SHAPE).reshape(-1, 3)
    inside = directions[area.contains(directions)]
    sets, others = limited.view_sets(), TANGENT[name].view_sets()
    assert sum(map(len, sets)) <= sum(map(len, others)) - (seed is None)
    shown = []
    for views in sets:
        grid: Any = views.grid
        of_set = grid.widened(1).shown(inside)
        if limited.blend == "nearest" or not grid.is_overlapping:
            of_set = np.take_along_axis(of_set, grid.owners(inside)[:, None], axis=1)
        shown.append(of_set.any(axis=1))
    if name == "rings of two widths":
        shown = [np.any(shown, axis=0)]
    assert np.all(shown)


@pytest.mark.parametrize("rotation", ["none", "yaw", "so3"])
@pytest.mark.parametrize("up", [None, 0])
@pytest.mark.parametrize("kind", ["tangent", "few", "equirect", "crops", "joint"])
def test_training_samples_have_one_size(rotation: Any, up: int | None, kind: str) -> None:
    """Under every rotation; they see more of the area than a random choice does."""
    area = SphereArea.of((-100, 60, -20, 40))
    made: dict[str, Any] = {
        "tangent": TangentRepresentation(0, 6, random_rotation=rotation),
        "few": TangentRepresentation(0, 6, random_rotation=rotation, faces_per_panorama=3),
        "equirect": EquirectRepresentation(6, random_rotation=rotation),
        "crops": EquirectRepresentation(6, random_rotation=rotation, crop_deg=90),
        "joint": copy.copy(TANGENT["rings of two widths"]),
    }
    made["joint"].random_rotation = rotation
    whole = made[kind].with_rotation(_rotations(up)[1])
    image = area.contains(equirect_directions(SHAPE)).astype(np.float32)
    shapes, seen = set(), []
    for representation in (whole.limited_to(area), whole):
        shown = [
            representation.sample(np.random.default_rng(seed)).render(image, "nearest")
            for seed in range(12)
        ]
        if representation is not whole:
            shapes = {views.shape for views in shown}
        seen.append(np.mean([views.mean() for views in shown]))
    assert len(shapes) == 1
    assert seen[0] > 1.25 * seen[1]
    if kind == "few":
        assert shapes == {(3, 64, 64)}


@pytest.mark.parametrize("angles", ANGLES)
@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize("rows", [128, 96])
def test_the_part_of_an_equirectangular_image_shows_the_area(
    angles: tuple[float, ...], seed: int | None, rows: int
) -> None:
    """Rendered back, every pixel of the area has the value that it had before."""
    of_area, of_views = _rotations(seed)
    area = SphereArea.of(angles).rotated(of_area)
    limited = EquirectRepresentation(6, rows=rows).with_rotation(of_views).limited_to(area)
    (views,) = limited.view_sets()
    image = equirect_directions(SHAPE).astype(np.float32)
    rendered = views.render(image, "bilinear")
    assert rendered.shape[1:3] == (views.window.height, views.window.width)
    assert rendered.shape[1] % 32 == rendered.shape[2] % 32 == 0
    scores, _ = views.on_canvas(torch.from_numpy(rendered).movedim(-1, 1), SHAPE)
    back = scores[0, :, 1:-1, 1:-1].movedim(0, -1).numpy()
    if back.shape[:2] == SHAPE:
        inside = area.contains(image)
        np.testing.assert_allclose(back[inside], image[inside], atol=0.06)
    device: Any = views.render(torch.from_numpy(image).movedim(-1, 0), "bilinear")
    np.testing.assert_allclose(device.movedim(1, -1).numpy(), rendered, atol=2e-3)


def test_averaged_rotations_of_a_narrow_part_are_one_view() -> None:
    averaged = EquirectRepresentation(5, rotations=3)
    assert len(averaged.limited_to(SphereArea(-60, 60, -30, 30)).view_sets()) == 1
    around = averaged.limited_to(SphereArea(-180, 180, -30, 30))
    assert [views.window.first for views in around.view_sets()] == [0, 43, 85]
    assert around.image_size == (32, 128)


def test_level_views_of_an_area_are_refused_for_more_than_that() -> None:
    row = HorizontalRepresentation(6, RINGS[:1], [100, 100], area=STRIP)
    assert len(row.limited_to(SphereArea.of(STRIP)).view_sets()[0]) == 8
    tilted = rotation_about((0, 1, 0), 0.5)
    for area, rotation in (
        (None, np.eye(3)),
        (SphereArea(-180, 180, -60, 30), np.eye(3)),
        (SphereArea.of(STRIP), tilted),
    ):
        with pytest.raises(SettingError, match=r"8 views that miss .* the (area|sphere)"):
            row.with_rotation(rotation).limited_to(area)
    assert row.with_rotation(tilted).limited_to(SphereArea.of(STRIP).rotated(tilted)).view_sets()
