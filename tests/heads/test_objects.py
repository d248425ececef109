"""Objects of views become objects of the panorama, in scenes of discs whose answer is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from models.segments import Segments
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    equirect_solid_angles,
    lonlat_to_xyz,
)
from tangent_train.heads.objects import Objects, described, join_objects
from tangent_train.inference.images import InputImage
from tangent_train.metrics.panoptic import LABEL, panoptic_sums, quality
from tangent_train.rendering.representations.views import PinholeViews

SHAPE = (256, 512)
RINGS = RingGrid(
    [{"pitch": 0, "views": 6}, {"pitch": 60, "views": 3}, {"pitch": -60, "views": 3}],
    (110, 110),
    (256, 256),
)
GRIDS = [TangentGrid(0, 8), TangentGrid(1, 9), RINGS]

# Longitude, latitude and radius in degrees, and class.
DISCS = [
    (0, 0, 60, 0),  # larger than a view of base level 1
    (180, 5, 9, 1),  # across the seam
    (40, 88, 8, 1),  # over a pole
    (100, -20, 6, 1),
    (111, -20, 4.5, 1),  # a neighbor of the same class, half a degree away
    (-100, 20, 10, 0),
    (-100, 20, 4, 2),  # in front of another
    (30, -89, 3, 2),
]


def numbers_at(directions: NDArray[Any], discs: Sequence[Any] = DISCS) -> NDArray[np.int32]:
    """Return the number of the last disc at each direction, 0 for none."""
    numbers = np.zeros(directions.shape[:-1], np.int32)
    for number, (longitude, latitude, radius, _) in enumerate(discs, 1):
        center = lonlat_to_xyz(np.radians([longitude, latitude]))
        numbers[directions @ center > np.cos(np.radians(radius))] = number
    return numbers


def seen(grid: PinholeGrid, discs: Sequence[Any] = DISCS, score: float = 1.0) -> Any:
    """Return views with the objects that a perfect network would find."""
    classes = np.array([disc[3] for disc in discs])
    segments = []
    for directions in grid.directions():
        found, numbers = np.unique(numbers_at(directions, discs), return_inverse=True)
        first = int(found[0] != 0)
        numbers = numbers.reshape(directions.shape[:2]) + first
        of_view = torch.from_numpy(classes[found[found > 0] - 1])
        scores = torch.full((len(of_view),), score)
        segments.append(Segments(torch.from_numpy(numbers), of_view, scores))
    return PinholeViews(grid), segments


def panoptic(objects: Objects) -> NDArray[Any]:
    label = np.append(0, objects.classes + 1)[objects.numbers]
    return label * LABEL + objects.numbers


def panorama(shape: tuple[int, int]) -> InputImage:
    return InputImage(np.zeros((*shape, 3), np.uint8))


def truth(discs: Sequence[Any] = DISCS) -> NDArray[Any]:
    numbers = numbers_at(equirect_directions(SHAPE), discs)
    return np.array([0, *(disc[3] + 1 for disc in discs)])[numbers] * LABEL + numbers


@pytest.mark.parametrize("grid", GRIDS, ids=["tangent 0", "tangent 1", "rings"])
def test_perfect_views_give_perfect_objects(grid: PinholeGrid) -> None:
    found = join_objects([seen(grid)], SHAPE)
    scores = quality(panoptic_sums(panoptic(found), truth(), 4)[1])
    assert len(found.scores) == len(DISCS)
    assert scores["rq"][0].tolist() == [1, 1, 1]
    assert scores["sq"][0].min() > 0.93  # borders are sampled
    for subset in (1, 2):  # across the seam; near a pole
        assert np.nanmin(scores["rq"][subset]) == 1


def test_views_without_overlap_cut_objects() -> None:
    """The first failing case: nothing shows that two masks beside a border are one object."""
    found = join_objects([seen(CubeGrid(128), [(45, 0, 10, 0), (0, 0, 10, 0)])], SHAPE)
    assert len(found.scores) == 3


def test_masks_of_one_view_never_join() -> None:
    """Two masks of one view overlap with a single mask of another; the better one joins it."""
    views, segments = seen(RINGS, [(20, 0, 8, 0)])
    numbers = segments[0].numbers
    columns = torch.arange(numbers.shape[1])
    cut = int(numbers.nonzero()[:, 1].float().quantile(0.7))
    split = numbers * (1 + (columns > cut).int())
    segments[0] = Segments(split, torch.zeros(2, dtype=torch.int64), torch.ones(2))
    found = join_objects([(views, segments)], SHAPE, least_overlap=0.1)
    sizes = np.bincount(found.numbers.ravel())[1:]
    assert len(sizes) == 2
    assert sizes.max() > 0.7 * sizes.sum()


def test_a_single_view_that_sees_an_object_is_outvoted() -> None:
    views, segments = seen(RINGS, [(0, 0, 10, 0)], 0.9)
    nothing = Segments(torch.zeros(256, 256).int(), torch.zeros(0).long(), torch.zeros(0))
    only = [of_view if k == 0 else nothing for k, of_view in enumerate(segments)]
    assert len(join_objects([(views, only)], SHAPE).scores) == 1  # seen in the middle of its view
    only = [of_view if k == 1 else nothing for k, of_view in enumerate(segments)]
    assert (
        len(join_objects([(views, only)], SHAPE).scores) == 0
    )  # at its border, another in the middle


def test_no_objects() -> None:
    found = join_objects([seen(RINGS, [])], SHAPE)
    assert not found.numbers.any()
    assert described(found, [], panorama(SHAPE)) == []


def test_scores_are_means_by_solid_angle() -> None:
    sets = [seen(RINGS, DISCS[1:2], 0.4), seen(RINGS, DISCS[1:2], 0.8)]
    assert join_objects(sets, SHAPE).scores == pytest.approx([0.6])


@pytest.mark.parametrize(
    "disc", [(0, 0, 10, 0), (180, 20, 5, 0), (40, 88, 8, 0), (-120, -45, 20, 0)]
)
def test_boxes_of_discs(disc: Any) -> None:
    longitude, latitude, radius, _ = disc
    numbers = numbers_at(equirect_directions((512, 1024)), [disc])
    cap = 2 * np.pi * (1 - np.cos(np.radians(radius)))
    objects = Objects(numbers, np.zeros(1, int), np.ones(1), np.array([cap]))
    (entry,) = described(objects, ["lamp"], panorama((512, 1024)))
    center = lonlat_to_xyz(np.radians([entry["longitude_deg"], entry["latitude_deg"]]))
    assert center @ lonlat_to_xyz(np.radians([longitude, latitude])) > np.cos(np.radians(0.2))
    assert entry["width_deg"] == pytest.approx(2 * radius, abs=0.4)
    assert entry["height_deg"] == pytest.approx(2 * radius, abs=0.4)
    (solid_angle,) = join_objects([seen(RINGS, [disc])], (512, 1024)).solid_angles
    assert solid_angle == pytest.approx(cap, rel=0.03)
    assert (entry["class"], entry["distance_m"]) == ("lamp", None)


def test_distances_are_medians_by_solid_angle_of_the_known_pixels() -> None:
    """A cap around the pole, whose distance grows with the angle from the pole."""
    shape, radius = (512, 1024), np.radians(40)
    numbers = numbers_at(equirect_directions(shape), [(0, 90, 40, 0)])
    from_pole = np.arccos(equirect_directions(shape)[..., 2])
    depth = np.rint(512 * (1 + from_pole)).astype(np.uint16)
    depth[:, :600] = 0  # unknown
    objects = Objects(numbers, np.zeros(1, int), np.ones(1), np.ones(1))
    (entry,) = described(objects, ["lamp"], replace(panorama(shape), depth=depth))
    half_of_the_cap = np.arccos((1 + np.cos(radius)) / 2)  # the rows alone would give 20°
    assert entry["distance_m"] == pytest.approx(1 + half_of_the_cap, abs=0.01)
    (entry,) = described(objects, ["lamp"], replace(panorama(shape), depth=0 * depth))
    assert entry["distance_m"] is None


def test_boxes_and_distances_of_photos() -> None:
    """A wall at 2 m, 20° wide to the right of the optical axis."""
    camera, size = camera_matrix_from_fov(90, (100, 200)), (100, 200)
    tangent = (np.arange(200) - 99.5) / 100
    numbers = np.zeros(size, np.int32)
    numbers[49:51, (tangent > np.tan(np.radians(20))) & (tangent < np.tan(np.radians(40)))] = 1
    depth = np.full(size, 2 * 512, np.uint16)
    image = InputImage(np.zeros((*size, 3), np.uint8), depth, camera_matrix=camera)
    objects = Objects(numbers, np.zeros(1, int), np.ones(1), np.ones(1))
    (entry,) = described(objects, ["wall"], image)
    assert entry["longitude_deg"] == pytest.approx(30, abs=0.3)
    assert (entry["width_deg"], entry["height_deg"]) == pytest.approx((20, 1), abs=0.6)
    half = np.arcsin(np.sin(np.radians([20, 40])).mean())  # of the solid angle of a row
    assert entry["distance_m"] == pytest.approx(2 / np.cos(half), rel=0.003)


def test_objects_outside_a_partial_panorama_are_left_out() -> None:
    valid = np.zeros(SHAPE, np.bool_)
    valid[:, 128:384] = True  # 90° to both sides
    found = join_objects([seen(RINGS)], SHAPE, valid=valid)
    inside = np.unique(truth()[valid])
    assert len(found.scores) == len(inside[inside > 0])
    assert not found.numbers[~valid].any()
    whole = join_objects([seen(RINGS)], SHAPE)
    is_chair = (panoptic(found) // LABEL == 2) & valid  # a disc far from the border
    np.testing.assert_array_equal(is_chair, (panoptic(whole) // LABEL == 2) & valid)
    per_pixel = equirect_solid_angles(SHAPE)[:, None] * np.ones(SHAPE)
    sums = [per_pixel[found.numbers == k + 1].sum() for k in range(len(found.scores))]
    np.testing.assert_allclose(found.solid_angles, sums)
