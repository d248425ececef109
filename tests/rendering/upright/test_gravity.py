"""The direction of up by rooms drawn with known rotations, and by poses rendered independently."""

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
from tangent_train.rendering.upright.gravity import estimate_up, up_from_pose, upright_rotation
from tests.geometry.directions import angle_deg
from tests.keypoints.textures import texture
from tests.rendering.drawn_room import draw_room

_UP = np.array([0.0, 0.0, 1.0])


def _tilted(tilt_deg: float, azimuth_deg: float, yaw_deg: float) -> NDArray[np.float64]:
    azimuth = math.radians(azimuth_deg)
    tilt = rotation_about((math.cos(azimuth), math.sin(azimuth), 0), math.radians(tilt_deg))
    return tilt @ rotation_about(_UP, math.radians(yaw_deg))


# From the picture


@pytest.mark.parametrize("shape", [(128, 256), (151, 303)])
@pytest.mark.parametrize(
    ("tilt_deg", "azimuth_deg", "yaw_deg"),
    [(0, 0, 45), (3, 200, 180), (20, 0, 179), (44, 45, 3)],
)
def test_tilted_rooms(
    shape: tuple[int, int], tilt_deg: float, azimuth_deg: float, yaw_deg: float
) -> None:
    turn = _tilted(tilt_deg, azimuth_deg, yaw_deg)
    gravity = estimate_up(draw_room(shape, turn))
    assert angle_deg(gravity.up, turn[:, 2]) < 0.5
    assert 0.9 < gravity.confidence <= 1
    np.testing.assert_array_equal(gravity.candidates[0], gravity.up)
    np.testing.assert_allclose(np.linalg.norm(gravity.candidates, axis=1), 1)


@pytest.mark.parametrize("seed", range(3))
def test_rooms_held_at_any_angle(seed: int) -> None:
    turn = random_rotation(np.random.default_rng(seed))
    gravity = estimate_up(draw_room((128, 256), turn), max_tilt_deg=180)
    assert angle_deg(gravity.up, turn[:, 2]) < 0.5
    assert len(gravity.candidates) >= 6
    # All axes of the room are candidates, upside down as well.
    for axis in (*turn.T, *-turn.T):
        assert min(angle_deg(axis, one) for one in gravity.candidates) < 0.5


def test_a_judge_chooses_among_the_axes_of_the_best_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    even = np.full(6, 1 / 6)
    monkeypatch.setattr("tangent_train.rendering.upright.gravity.up_probabilities", lambda *_: even)
    turn = random_rotation(np.random.default_rng(0))
    room = draw_room((128, 256), turn)
    asked: list[NDArray[np.float64]] = []

    def judge(ups: NDArray[np.float64]) -> NDArray[np.float64]:
        asked.append(ups)
        return 30 * ups @ wanted

    wanted = turn[:, 2]
    estimate_up(room, 180, judge)
    (axes,) = asked
    assert len(axes) == 6
    for one in axes:
        assert min(angle_deg(axis, one) for axis in (*turn.T, *-turn.T)) < 0.5
    assert (axes @ axes.T - np.eye(6) < 0.01).all()
    for wanted in axes:
        gravity = estimate_up(room, 180, judge)
        np.testing.assert_array_equal(gravity.up, wanted)
        assert gravity.confidence > 0.9


def test_what_is_hopeless_or_the_only_one_is_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    def judge(ups: NDArray[np.float64]) -> NDArray[np.float64]:
        raise AssertionError(ups)

    turn = _tilted(3, 200, 180)
    assert angle_deg(estimate_up(draw_room((128, 256), turn), 60, judge).up, turn[:, 2]) < 0.5
    estimate_up(_without_structure()["black"], 180, judge)
    certain = np.array([0.001, 0.001, 0.996, 0.001, 0.001, 0])
    place = "tangent_train.rendering.upright.gravity.up_probabilities"
    monkeypatch.setattr(place, lambda *_: certain)
    assert estimate_up(draw_room((128, 256), turn), 180, judge).confidence > 0.9


def test_upside_down() -> None:
    turn = rotation_about((1, 0, 0), math.pi)
    room = draw_room((128, 256), turn)
    assert angle_deg(estimate_up(room, 180).up, -_UP) < 0.5
    # Not to be considered: the axis that is nearest to upright is that of the floor.
    assert angle_deg(estimate_up(room).up, _UP) < 0.5


def test_no_direction_beyond_the_largest_tilt() -> None:
    gravity = estimate_up(draw_room((128, 256), _tilted(20, 0, 45)), max_tilt_deg=5)
    assert angle_deg(gravity.up, _UP) < 5
    assert all(angle_deg(one, _UP) < 5 for one in gravity.candidates)
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
@pytest.mark.parametrize("max_tilt_deg", [45, 180])
def test_nothing_is_done_where_nothing_is_found(name: str, max_tilt_deg: float) -> None:
    up, confidence, candidates = estimate_up(_without_structure()[name], max_tilt_deg)
    np.testing.assert_array_equal(up, _UP)
    assert confidence == 0
    assert candidates.shape[1:] == (3,)


def test_dark_rooms_with_missing_parts() -> None:
    turn = _tilted(18, 130, 60)
    room = draw_room((128, 256), turn) // 8
    room[:12], room[-9:], room[:, 30:45] = 0, 0, 0
    assert angle_deg(estimate_up(room).up, turn[:, 2]) < 0.5


@pytest.mark.parametrize(
    ("panorama", "found"),
    [
        (np.zeros((8, 16), np.uint8), r"shape \(8, 16\)"),
        (np.zeros((8, 16, 3), np.float32), "dtype float32"),
    ],
)
def test_other_arrays_are_refused(panorama: NDArray[Any], found: str) -> None:
    with pytest.raises(SettingError, match=f"panorama: found .*{found}"):
        estimate_up(panorama)


# Rotating upright


@given(st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda up: np.linalg.norm(up) > 1e-3))
def test_the_smallest_rotation(up: tuple[float, float, float]) -> None:
    turn = upright_rotation(up)
    direction = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(turn @ _UP, direction, atol=1e-9)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0
    # The angle of a rotation is in its trace; no smaller one moves z that far.
    assert math.isclose(np.trace(turn), 1 + 2 * direction[2], abs_tol=1e-9)


def test_the_poles() -> None:
    np.testing.assert_array_equal(upright_rotation((0, 0, 2)), np.eye(3))
    np.testing.assert_allclose(upright_rotation((0, 0, -1)), np.diag([-1.0, 1, -1]), atol=1e-15)
    np.testing.assert_allclose(upright_rotation((1e-200, 0, 1)), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("up", [(0, 0, 0), (0, 1), (math.nan, 0, 1), (math.inf, 0, 1), 3.0])
def test_no_direction(up: Any) -> None:
    with pytest.raises(SettingError, match=r"up: found .*three numbers"):
        upright_rotation(up)


# From the pose


def _horizon_of_pose(pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """Height in the world, −1 to 1, of what every pixel of a panorama sees.

    By the axes of Google's format: x right, y forward, z up; rotated by the heading (clockwise
    about z), the pitch about x, the roll about y, in that order, each about the axes as already
    rotated.
    """
    turn = Rotation.from_euler("ZXY", [-77, pitch_deg, roll_deg], degrees=True).as_matrix()
    local = equirect_directions((360, 720))[..., [1, 0, 2]]
    return np.asarray((local @ turn.T)[..., 2])


@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg"),
    [(0, 0), (30, 0), (0, -150), (-24.49, 8.96), (-90, 50)],
)
def test_up_is_that_of_the_rendered_heights(pitch_deg: float, roll_deg: float) -> None:
    heights = _horizon_of_pose(pitch_deg, roll_deg)
    up = up_from_pose(pitch_deg, roll_deg)
    np.testing.assert_allclose(equirect_directions((360, 720)) @ up, heights, atol=1e-12)
