from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    PinholeGrid,
    RingGrid,
    TangentGrid,
    equirect_directions,
    rotation_about,
)
from tangent_train.rendering import (
    CubemapRepresentation,
    EquirectRepresentation,
    HorizontalRepresentation,
    Representation,
    TangentRepresentation,
)
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.views import PinholeViews
from tests.geometry.directions import unit
from tests.rendering.reference import certain_labels, panorama_lonlat, sample_panorama

SHAPE = (64, 128)
TILT = rotation_about((1, 2, 0), math.radians(50)) @ rotation_about((0, 0, 1), 1)


def _labels() -> NDArray[np.uint8]:
    """Labels of the eight octants of the sphere, 1 to 8."""
    positive = equirect_directions(SHAPE) @ [[1, 2, 0], [2, -1, 0], [0, 0.5, 1]] > 0
    return (positive @ [1, 2, 4] + 1).astype(np.uint8)


def _scores(labels: NDArray[np.uint8]) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.from_numpy(labels).long(), 9).movedim(-1, 1).float()


def _labels_of(
    representation: Representation, scores: Sequence[torch.Tensor], shape: tuple[int, int] = SHAPE
) -> NDArray[np.unsignedinteger]:
    sets = representation.view_sets()
    several, blend = len(sets) > 1, representation.blend
    mosaic = ScoreMosaic(shape, scores[0].shape[1], blend, averaged=several)
    for views, of_set in zip(sets, scores, strict=True):
        mosaic.add(of_set, views)
    return mosaic.labels().numpy()


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


RINGS = [{"pitch": 0, "views": 8}, {"pitch": 40, "views": 5}, {"pitch": -40, "views": 5}]
WIDE_RINGS = [{"pitch": 0, "views": 6, "fov": 130}, *RINGS[1:]]

REPRESENTATIONS: list[Representation] = [
    HorizontalRepresentation(5, RINGS, 100),
    HorizontalRepresentation(5, RINGS, (110, 100), 40, blend="nearest", mirror=True),
    HorizontalRepresentation(5, WIDE_RINGS, 100),
    HorizontalRepresentation(5, None, (62, 48), (30, 30), square_pixels=False),
    TangentRepresentation(0, 5),
    TangentRepresentation(1, 5, blend="feather"),
    TangentRepresentation(0, 5, crop_multiple=8, random_rotation="so3", mirror=True),
    CubemapRepresentation(5),
    CubemapRepresentation(5, dim=41, random_rotation="so3", mirror=True),
    CubemapRepresentation(5, margin=7, blend="feather"),
    EquirectRepresentation(5),
    EquirectRepresentation(5, crop_deg=90, random_rotation="yaw", mirror=True),
    EquirectRepresentation(5, rows=100),
    EquirectRepresentation(5, rows=60, rotations=3),
]


@pytest.mark.parametrize("representation", REPRESENTATIONS)
@pytest.mark.parametrize("rotation", [None, TILT])
def test_labels_come_back_from_the_views_of_the_whole_sphere(
    representation: Representation, rotation: NDArray[np.float64] | None
) -> None:
    labels = _labels()
    source = representation if rotation is None else representation.with_rotation(rotation)
    rendered = [views.render(labels, "nearest") for views in source.view_sets()]
    assert {images.shape[1:] for images in rendered} == {representation.image_size}
    back = _labels_of(source, [_scores(images) for images in rendered])
    assert np.mean(back == labels) > 0.95, "all but the borders between classes"


@pytest.mark.parametrize("fov", [(62, 48), (100, 60), (40, 70), (120, 120)])
@pytest.mark.parametrize("overlap", [0.1, 0.3])
def test_rings_of_any_field_of_view_cover_the_sphere(
    fov: tuple[float, float], overlap: float
) -> None:
    # Views that leave a gap, or meet only at their edges, are refused or do not overlap.
    grid = HorizontalRepresentation(
        5, None, fov, (24, 24), square_pixels=False, overlap=overlap
    ).grid
    assert grid.is_overlapping
    assert np.degrees(2 * np.arctan(grid.half_size)) == pytest.approx(fov)
    ideal = 4 * math.pi / (4 * math.asin(np.prod(np.sin(np.radians(fov) / 2))))
    assert grid.num_images < 3.5 * ideal / (1 - overlap) ** 2


@pytest.mark.parametrize("build", [partial(TangentRepresentation, 0), EquirectRepresentation])
def test_rotations_have_a_limit(build: Any) -> None:
    for count in (0, 361, 10**9):
        with pytest.raises(SettingError, match=f"rotations: found {count}; .* from 1 to 360"):
            build(5, rotations=count)
    assert len(build(5, rotations=3).view_sets()) == 3


@pytest.mark.parametrize(
    "representation",
    [
        TangentRepresentation(0, 5, faces_per_panorama=5, random_rotation="so3", mirror=True),
        CubemapRepresentation(5, random_rotation="yaw", mirror=True),
        CubemapRepresentation(5, random_rotation="so3"),
        HorizontalRepresentation(5, RINGS, 100, None, 6, "yaw", mirror=True),
        HorizontalRepresentation(5, WIDE_RINGS, 100, None, 6, "yaw", mirror=True),
        EquirectRepresentation(5, crop_deg=60, random_rotation="yaw", mirror=True),
        EquirectRepresentation(5, random_rotation="so3"),
    ],
)
def test_samples_depend_only_on_the_generator_and_the_rotation(
    representation: Representation,
) -> None:
    labels = _labels()
    image = labels.astype(np.float32)
    seen = []
    for seed in (0, 0, 1):
        views = representation.sample(_rng(seed))
        image_views, label_views = (views.render(x, "nearest") for x in (image, labels))
        np.testing.assert_array_equal(image_views, label_views)
        assert label_views.flags.c_contiguous
        assert label_views.dtype == np.uint8
        seen.append(label_views)
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])
    plain, rotated = (
        r.sample(_rng()).render(equirect_directions(SHAPE).astype(np.float32), "bilinear")
        for r in (representation, representation.with_rotation(TILT))
    )
    np.testing.assert_allclose(rotated, plain @ TILT.T, atol=0.05)


def test_random_faces_do_not_repeat_and_all_occur() -> None:
    representation = TangentRepresentation(0, 5, faces_per_panorama=5)
    x = np.arange(64 * 128, dtype=np.float32).reshape(SHAPE)
    whole = representation.view_sets()[0].render(x, "nearest")
    drawn = set()
    for seed in range(30):
        views = representation.sample(_rng(seed)).render(x, "nearest")
        faces = [int(np.flatnonzero((whole == v).all(axis=(1, 2)))[0]) for v in views]
        assert len(set(faces)) == 5
        drawn.update(faces)
    assert drawn == set(range(20))


def test_crops_are_whole_columns_at_random_longitudes_and_cross_the_seam() -> None:
    x = np.tile(np.arange(128), (64, 1)).astype(np.uint8)
    representation = EquirectRepresentation(5, crop_deg=90)
    starts, crossing = set(), 0
    for seed in range(50):
        (view,) = representation.sample(_rng(seed)).render(x, "nearest")
        assert view.shape == (64, 32)
        first = int(view[0, 0])
        np.testing.assert_array_equal(view[0], (first + np.arange(32)) % 128)
        starts.add(first)
        crossing += first > 96
    assert len(starts) > 20
    assert crossing > 3


def test_cropping_takes_the_least_covering_side_that_is_a_multiple() -> None:
    assert TangentRepresentation(0, 6, crop_multiple=16).grid.dim == 48
    assert TangentRepresentation(0, 7, crop_multiple=32).grid.dim == 96
    assert TangentRepresentation(0, 6, crop_multiple=1).grid.dim == 46


@pytest.mark.parametrize(
    ("made", "settings", "message"),
    [
        (TangentRepresentation, {"dim": 64, "crop_multiple": 16}, "representation.dim"),
        (TangentRepresentation, {"dim": 8}, "dim: found 8; expected at least 24"),
        (TangentRepresentation, {"blend": "average"}, "'nearest' or 'feather'"),
        (HorizontalRepresentation, {"fov": 180}, "fov: found 180; expected more than 0 and less"),
        (
            HorizontalRepresentation,
            {"rings": WIDE_RINGS[:2]},
            r"11 views that miss .*latitude -\d\d°",
        ),
        (
            HorizontalRepresentation,
            {"rings": WIDE_RINGS, "blend": "nearest"},
            "expected feather, or the",
        ),
    ],
)
def test_impossible_settings_are_refused(made: Any, settings: dict[str, Any], message: str) -> None:
    needed: dict[Any, dict[str, Any]] = {
        TangentRepresentation: {"base_level": 0},
        HorizontalRepresentation: {"rings": RINGS, "fov": 100},
    }
    with pytest.raises(SettingError, match=message):
        made(**needed.get(made, {}) | {"level": 5} | settings)


@pytest.mark.parametrize("rows", [24, 100])
def test_scores_of_other_rows_are_interpolated_around_the_sphere(rows: int) -> None:
    """Compared with bilinear interpolation in double precision, across seam and poles."""
    scores = torch.randn(1, 3, rows, 2 * rows, generator=torch.Generator().manual_seed(0))
    found = _labels_of(EquirectRepresentation(5, rows=rows), [scores])
    image = scores[0].movedim(0, -1).double().numpy()
    expected = sample_panorama(image, panorama_lonlat(SHAPE), "bilinear")
    clear = certain_labels(expected, margin=1e-4)
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(found[clear], expected.argmax(axis=-1)[clear])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    "grid",
    [
        TangentGrid(1, 5, 20, TILT),
        RingGrid(RINGS, (110, 100), (20, 33), TILT),
        RingGrid(RINGS, (110, 100), (20, 33), TILT, square_pixels=False),
    ],
)
def test_rays_are_the_directions_of_the_pixels(grid: PinholeGrid, mirrored: bool) -> None:
    faces = np.array([3, 17, 12])
    views = PinholeViews(grid, faces, mirrored)
    y, x = np.meshgrid(*((2 * np.arange(n) + 1) / n - 1 for n in grid.size), indexing="ij")
    seen = unit(np.einsum("nwc,ijc->nijw", views.rays(), np.stack([x, y, 0 * x + 1], axis=-1)))
    expected = grid.directions(faces)
    np.testing.assert_allclose(seen, expected[:, :, ::-1] if mirrored else expected, atol=1e-6)
