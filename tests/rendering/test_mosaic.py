"""Scores accumulated image by image, against those rendered in one call."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    random_rotation,
    rotation_about,
)
from tangent_train.rendering import (
    Blend,
    PerspectiveRepresentation,
    numba_sums,
    tangent_to_equirect,
    tangent_to_labels,
)
from tangent_train.rendering.mosaic import MeanMosaic, ScoreMosaic
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.views import PinholeViews

Mosaic = TypeVar("Mosaic", ScoreMosaic, MeanMosaic)

RINGS = [{"pitch": pitch, "views": 5} for pitch in (0, 50, -50)]
GRIDS = [
    (TangentGrid(0, 5), (64, 128)),
    (TangentGrid(1, 6, rotation=random_rotation(np.random.default_rng(1))), (101, 203)),
    (TangentGrid(2, 6, dim=TangentGrid.least_dim(2, 6)), (48, 96)),
    (TangentGrid(1, 5, dim=40), (30, 61)),
    (TangentGrid(0, 4, rotation=rotation_about((1, 0, 0), math.pi / 2)), (32, 64)),
    (RingGrid(RINGS, (110, 90), (20, 31), random_rotation(np.random.default_rng(2))), (45, 90)),
]


def _scores(grid: PinholeGrid, classes: int = 7) -> torch.Tensor:
    generator = torch.Generator().manual_seed(grid.num_images)
    return 3 * torch.randn(grid.num_images, classes, *grid.size, generator=generator)


def _added(result: Mosaic, scores: torch.Tensor, grid: PinholeGrid) -> Mosaic:
    for faces in np.array_split(np.random.default_rng(0).permutation(grid.num_images), 6):
        result.add(scores[faces], PinholeViews(grid, faces))
    return result


def _labels(mosaic: ScoreMosaic) -> NDArray[np.unsignedinteger]:
    return mosaic.labels().numpy()


def _probabilities(mosaic: ScoreMosaic) -> NDArray[np.float32]:
    return mosaic.probabilities(slice(None)).numpy()


@pytest.mark.parametrize(
    ("grid", "shape", "averaged"),
    [*((*case, True) for case in GRIDS), *((*case, False) for case in GRIDS[:2])],
)
def test_owners_labels_are_those_of_all_images_at_once(
    grid: TangentGrid, shape: tuple[int, int], averaged: bool
) -> None:
    scores = _scores(grid)
    result = _added(ScoreMosaic(shape, 7, "nearest", averaged=averaged), scores, grid)
    expected = tangent_to_labels(scores.double(), grid, shape).numpy()
    # Where two images are equally near, as on the meridians of their edges, both may be right.
    nearest, second = -np.sort(-equirect_directions(shape) @ grid.centers_xyz.T)[..., :2].T
    decided = (nearest - second > 1e-9).T
    assert decided.mean() > 0.99
    # Another order of the same sums: only ties of rounding may differ.
    assert (_labels(result) == expected)[decided].mean() > 0.9995


# Differences of hundreds have exponentials that vanish; more than 16 classes are several blocks.
@pytest.mark.parametrize(
    ("grid", "shape", "classes", "scale"),
    [*((*case, 7, 1) for case in GRIDS), (*GRIDS[1], 7, 100), (*GRIDS[3], 40, 1)],
)
def test_feathered_probabilities_are_those_of_all_images_at_once(
    grid: TangentGrid, shape: tuple[int, int], classes: int, scale: float
) -> None:
    scores = scale * _scores(grid, classes)
    result = _added(ScoreMosaic(shape, classes, "feather"), scores, grid)
    softmax = scores.double().softmax(dim=1)
    expected = tangent_to_equirect(softmax, grid, shape, "feather").movedim(0, -1).numpy()
    np.testing.assert_allclose(_probabilities(result), expected, atol=1e-6)
    labels = tangent_to_labels(softmax, grid, shape, "feather").numpy()
    assert (_labels(result) == labels).mean() > 0.9995


def test_probabilities_of_owners_are_the_softmax_of_the_interpolated_scores() -> None:
    grid, shape = GRIDS[1]
    scores = _scores(grid)
    result = _added(ScoreMosaic(shape, 7, "nearest", averaged=True), scores, grid)
    expected = tangent_to_equirect(scores.double(), grid, shape).softmax(dim=0).movedim(0, -1)
    np.testing.assert_allclose(_probabilities(result), expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(result.sums.sum(axis=2), 1, atol=1e-5)  # each counted once


@pytest.mark.parametrize("backend", ["numba", "torch"])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_classes_of_minus_infinity_have_no_probability(blend: Blend, backend: Any) -> None:
    grid, shape = GRIDS[0]
    scores = torch.full((20, 300, *grid.size), -torch.inf)
    scores[:, 1], scores[:, 299] = 0, 0
    result = ScoreMosaic(shape, 300, blend, averaged=True, backend=backend)
    found = _probabilities(_added(result, scores, grid))
    np.testing.assert_allclose(found[..., [1, 299]], 0.5, atol=1e-6)
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-6)
    assert _labels(result).dtype == np.uint16
    assert (_labels(result) == 1).all()


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_a_score_of_minus_infinity_never_wins_and_does_not_spoil_others(
    backend: Any, averaged: bool
) -> None:
    """At borders of cube faces, an infinite score has a weight of 0."""
    grid, shape = CubeGrid(16), (64, 128)
    scores = _scores(grid)
    scores[torch.rand(scores.shape, generator=torch.Generator().manual_seed(0)) < 0.3] = -torch.inf
    scores[:, 6] = -9
    expected = tangent_to_equirect(scores.double().clamp(min=-1e30), grid, shape).argmax(dim=0)
    result = ScoreMosaic(shape, 7, "nearest", averaged=averaged, backend=backend)
    np.testing.assert_array_equal(_labels(_added(result, scores, grid)), expected)
    assert result.not_finite == 0


@pytest.mark.parametrize(
    ("wrong", "averaged"), [(torch.nan, False), (torch.inf, True), (-torch.inf, True)]
)
@pytest.mark.parametrize("backend", ["numba", "torch"])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_scores_that_are_not_finite_make_all_pixels_unknown_that_depend_on_them(
    blend: Blend, backend: Any, averaged: bool, wrong: float
) -> None:
    grid, shape = GRIDS[0]
    scores = _scores(grid)
    expected = _labels(_added(ScoreMosaic(shape, 7, blend, backend=backend), scores, grid))
    seen = torch.zeros(20, 1, *grid.size)
    seen[:5, :, 3:] = 1
    spoiled = tangent_to_equirect(seen, grid, shape, blend)[0].numpy() > 0
    assert 0.1 < spoiled.mean() < 0.6
    scores[:5, slice(None) if wrong < 0 else 3, 3:] = wrong
    result = ScoreMosaic(shape, 7, blend, averaged=averaged, backend=backend)
    _added(result, scores.double(), grid)  # networks may compute in float64
    labels = _labels(result)
    np.testing.assert_array_equal(labels, np.where(spoiled, 7, expected))
    assert float(result.not_finite) == pytest.approx(spoiled.mean())
    if averaged or blend == "feather":
        assert (_probabilities(result).sum(axis=-1) > 0.99).tolist() == (~spoiled).tolist()
    given = scores.softmax(1) if blend == "feather" else scores
    found = tangent_to_labels(given, grid, shape, blend)
    np.testing.assert_array_equal(found == 7, spoiled)


def test_large_sums_are_in_a_file_and_equal(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, shape = GRIDS[0]
    scores = _scores(grid)
    expected = _probabilities(_added(ScoreMosaic(shape, 7, "feather"), scores, grid))
    monkeypatch.setattr(numba_sums, "_IN_MEMORY_BYTES", 0)
    result = _added(ScoreMosaic(shape, 7, "feather"), scores, grid)
    assert isinstance(result.sums, np.memmap)
    np.testing.assert_array_equal(_probabilities(result), expected)


@pytest.mark.parametrize("blend", ["nearest", "feather"])
@pytest.mark.parametrize(("grid", "shape"), GRIDS)
def test_depth_is_the_weighted_mean_of_known_pixels(
    grid: TangentGrid, shape: tuple[int, int], blend: Blend
) -> None:
    depth = _scores(grid, 1)
    depth[torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) < 0.2] = torch.nan
    depth[0] = torch.inf
    depth[torch.from_numpy(grid.directions()[:, None] @ (0.6, 0, 0.8) > 0.7)] = torch.nan
    result = _added(MeanMosaic(shape, blend), depth, grid)
    assert result.sums.shape[2] == 2, "16 numbers per pixel would be half a gigabyte at level 10"
    known = depth.isfinite()
    pair = torch.cat([depth.where(known, 0), known.float()], dim=1).double()
    total, weight = tangent_to_equirect(pair, grid, shape, blend)
    values = result.values()[0]
    least = 0.5 if blend == "nearest" else 0.05
    seen = weight > least + 1e-6
    torch.testing.assert_close(values[seen].double(), (total / weight)[seen], atol=1e-4, rtol=1e-4)
    if blend == "nearest":
        assert values[weight < least - 1e-6].isnan().all()
    assert values[weight < 1e-9].isnan().all()
    assert values.isnan().any()


def _photo_crops(blend: Blend) -> tuple[PhotoCrops, tuple[int, int]]:
    size = (45, 70)
    camera = PerspectiveRepresentation(level=5, fov_deg=30.0, dim=(20, 24))
    sampler = camera.of_camera(camera_matrix_from_fov(70.0, size), size)
    return sampler.cover(0.3 if blend == "feather" else 0.0), size


@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_crops_of_a_smooth_field_give_the_field(blend: Blend) -> None:
    """Two classes whose log-odds are linear over the photo: interpolation is exact inside."""
    crops, (height, width) = _photo_crops(blend)
    rows, columns = crops.size
    x = np.linspace(crops.boxes[:, 0], crops.boxes[:, 2], 2 * columns + 1, axis=1)[:, 1::2]
    y = np.linspace(crops.boxes[:, 1], crops.boxes[:, 3], 2 * rows + 1, axis=1)[:, 1::2]
    field = 0.05 * (x[:, None, :] - 30) + 0.08 * (y[:, :, None] - 20)
    scores = torch.from_numpy(np.stack([np.zeros_like(field), field], axis=1)).float()
    result = ScoreMosaic((height, width), 2, blend, averaged=True)
    for part in (slice(0, 5), slice(5, None)):
        result.add(scores[part], crops[part])
    tolerance = 1e-5 if blend == "nearest" else 2e-3  # probabilities, not scores, are feathered
    truth = 0.05 * (np.arange(width) + 0.5 - 30) + 0.08 * (np.arange(height)[:, None] + 0.5 - 20)
    inside = slice(4, -4)
    probability = _probabilities(result)[..., 1]
    expected = 1 / (1 + np.exp(-truth))
    np.testing.assert_allclose(
        probability[inside, inside], expected[inside, inside], atol=tolerance
    )
    decided = np.abs(truth) > 0.05
    assert ((_labels(result) == 1) == (truth > 0))[inside, inside][decided[inside, inside]].all()
