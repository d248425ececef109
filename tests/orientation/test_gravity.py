"""The direction of up, from rooms drawn with known rotations and from pose tags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, random_rotation, rotation_about
from tangent_train.orientation.gravity import (
    estimate_up,
    up_from_pose,
    upright_rotation,
)
from tangent_train.orientation.manhattan import (
    LineSegments,
    find_line_segments,
    find_manhattan_frames,
)
from tests.geometry.directions import angle_deg, unit
from tests.keypoints.textures import texture
from tests.rendering.drawn_room import draw_room


def test_rims_of_missing_parts_are_not_edges() -> None:
    ramp = np.linspace(90, 200, 256, dtype=np.uint8)
    image = np.broadcast_to(ramp[:, None, None], (256, 512, 3)).copy()
    image[60:190, 180:340] = 20
    assert len(find_line_segments(image).lengths_rad) >= 4
    image[image == 20] = 0
    assert not len(find_line_segments(image).lengths_rad)


@pytest.mark.parametrize("height", [128, 700])
def test_an_edge_all_around_is_found_on_its_great_circle(height: int) -> None:
    normal = unit(np.random.default_rng(height).normal(size=3))
    side = np.clip(equirect_directions((height, 2 * height)) @ normal * height / 3, -1, 1)
    gray = (130 + 60 * side).astype(np.uint8)
    segments = find_line_segments(np.repeat(gray[..., None], 3, axis=-1))
    sines = np.linalg.norm(np.cross(segments.normals_xyz, normal), axis=1)
    assert np.median(sines) < math.radians(0.3)
    # No end is two pixels off; where a corner of a face is cut, the piece is short.
    pixel = math.radians(90) / max(128, height * 2 / math.pi)
    assert (sines * segments.lengths_rad / 2).max() < 2 * pixel
    assert 0.9 < segments.lengths_rad.sum() / (2 * math.pi) < 1.05
    assert np.abs(segments.middles_xyz @ normal).max() < pixel
    np.testing.assert_allclose(np.linalg.norm(segments.middles_xyz, axis=1), 1)
    assert np.all(np.diff(segments.lengths_rad) <= 0)


@pytest.mark.parametrize("counts", [(20, 20, 20), (40, 15, 0), (5, 30, 5)])
def test_frames_of_exact_segments(counts: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    axes = random_rotation(rng)
    others = unit(rng.normal(size=(30, 3)))
    along = np.concatenate([np.repeat(axes.T, counts, axis=0), others])
    normals, middles = (unit(np.cross(along, rng.normal(size=along.shape))) for _ in range(2))
    segments = LineSegments(normals, middles, rng.uniform(0.1, 0.6, len(along)))
    frame = find_manhattan_frames(segments)[0]
    agreement = np.abs(frame.axes_xyz.T @ axes)
    np.testing.assert_allclose(np.sort(agreement, axis=1), np.tile([0, 0, 1.0], (3, 1)), atol=0.02)
    np.testing.assert_allclose(frame.axes_xyz.T @ frame.axes_xyz, np.eye(3), atol=1e-9)
    assert frame.significance > 3


_UP = np.array([0.0, 0.0, 1.0])


def _tilted(tilt_deg: float, azimuth_deg: float, yaw_deg: float) -> NDArray[np.float64]:
    azimuth = math.radians(azimuth_deg)
    tilt = rotation_about((math.cos(azimuth), math.sin(azimuth), 0), math.radians(tilt_deg))
    return tilt @ rotation_about(_UP, math.radians(yaw_deg))


# From the picture


def _up(*given: Any) -> NDArray[np.float64]:
    up = estimate_up(*given)
    assert up is not None
    return up


@pytest.mark.parametrize(
    ("shape", "tilt_deg", "azimuth_deg", "yaw_deg"),
    [((128, 256), 0, 0, 45), ((151, 303), 20, 0, 179), ((128, 256), 44, 45, 3)],
)
def test_up_is_found_in_tilted_rooms(
    shape: tuple[int, int], tilt_deg: float, azimuth_deg: float, yaw_deg: float
) -> None:
    rotation = _tilted(tilt_deg, azimuth_deg, yaw_deg)
    assert angle_deg(_up(draw_room(shape, rotation)), rotation[:, 2]) < 0.5


@pytest.mark.parametrize("seed", range(2))
def test_up_is_found_under_arbitrary_rotation(seed: int) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    assert angle_deg(_up(draw_room((128, 256), rotation), 180), rotation[:, 2]) < 0.5


def test_a_judge_chooses_among_the_axes_of_the_best_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    even = np.full(6, 1 / 6)
    monkeypatch.setattr("tangent_train.orientation.gravity.up_probabilities", lambda *_: even)
    rotation = random_rotation(np.random.default_rng(0))
    room = draw_room((128, 256), rotation)
    judged_axes: list[NDArray[np.float64]] = []

    def judge(ups: NDArray[np.float64]) -> NDArray[np.float64]:
        judged_axes.append(ups)
        return 30 * ups @ wanted

    wanted = rotation[:, 2]
    estimate_up(room, 180, judge)
    (axes,) = judged_axes
    assert len(axes) == 6
    for one in axes:
        assert min(angle_deg(axis, one) for axis in (*rotation.T, *-rotation.T)) < 0.5
    assert (axes @ axes.T - np.eye(6) < 0.01).all()
    for wanted in axes:
        np.testing.assert_array_equal(estimate_up(room, 180, judge), wanted)


def test_no_direction_beyond_the_largest_tilt() -> None:
    assert estimate_up(draw_room((128, 256), _tilted(20, 0, 45)), max_tilt_deg=5) is None
    with pytest.raises(SettingError, match="max_tilt_deg: found 181"):
        estimate_up(draw_room((8, 16), np.eye(3)), max_tilt_deg=181)


def _without_structure() -> dict[str, NDArray[np.uint8]]:
    noise = np.random.default_rng(0).integers(0, 256, (128, 256, 3), np.uint8)
    part = np.zeros_like(noise)
    part[40:90, 60:200] = noise[40:90, 60:200]
    ramp = np.linspace(0, 255, 128).astype(np.uint8)
    return {
        "black": np.zeros((128, 256, 3), np.uint8),
        "one pixel": np.full((1, 1, 3), 90, np.uint8),
        "ramp": np.broadcast_to(ramp[:, None, None], (128, 256, 3)).copy(),
        "noise": noise,
        "noise on a part": part,
        "noise of the same look everywhere": texture((128, 256))[..., None].repeat(3, axis=-1),
    }


@pytest.mark.parametrize("name", list(_without_structure()))
def test_images_without_structure_have_no_estimate(name: str) -> None:
    assert estimate_up(_without_structure()[name], 180) is None


def test_up_is_found_in_dark_rooms_with_missing_parts() -> None:
    rotation = _tilted(18, 130, 60)
    room = draw_room((128, 256), rotation) // 8
    room[:12], room[-9:], room[:, 30:45] = 0, 0, 0
    assert angle_deg(_up(room), rotation[:, 2]) < 0.5


# Rotating upright


@given(st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda up: np.linalg.norm(up) > 1e-3))
def test_the_rotation_is_the_smallest(up: tuple[float, float, float]) -> None:
    rotation = upright_rotation(up)
    direction = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(rotation @ _UP, direction, atol=1e-9)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    # The angle of a rotation is in its trace; no smaller one moves z that far.
    assert math.isclose(np.trace(rotation), 1 + 2 * direction[2], abs_tol=1e-9)


# From the pose


def _horizon_of_pose(pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """Return the height in the world, −1 to 1, of every pixel of a panorama.

    Computed in the axes of Google's format: x right, y forward, z up. They are rotated by the
    heading (clockwise about z), the pitch (about x) and the roll (about y), in that order, each
    about the rotated axes.
    """
    rotation = Rotation.from_euler("ZXY", [-77, pitch_deg, roll_deg], degrees=True).as_matrix()
    local = equirect_directions((360, 720))[..., [1, 0, 2]]
    return np.asarray((local @ rotation.T)[..., 2])


@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg"),
    [(0, 0), (30, 0), (0, -150), (-24.49, 8.96), (-90, 50)],
)
def test_up_is_that_of_the_rendered_heights(pitch_deg: float, roll_deg: float) -> None:
    heights = _horizon_of_pose(pitch_deg, roll_deg)
    up = up_from_pose(pitch_deg, roll_deg)
    np.testing.assert_allclose(equirect_directions((360, 720)) @ up, heights, atol=1e-12)
