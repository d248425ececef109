from __future__ import annotations

import math

import numpy as np
import pytest

from datamodules.synthrooms.camera import (
    PanoramaView,
    PerspectiveView,
    Pose,
    draw_view,
    euler_angles,
    euler_rotation,
)
from tangent_train.geometry import (
    FLIP_Y,
    equirect_directions,
    random_rotation,
    rotation_about,
)

HERE = np.array([1.0, 2.0, 1.5])


@pytest.mark.parametrize("seed", range(3))
def test_euler_angles_give_their_rotation_back(seed: int) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    down = euler_rotation(np.array([0.3, math.pi / 2, 0.8]))  # two axes coincide
    np.testing.assert_allclose(euler_rotation(euler_angles(down)), down, atol=1e-9)
    np.testing.assert_allclose(euler_rotation(euler_angles(rotation)), rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("heading", "pitch", "forward"),
    [
        (0.0, 0.0, [1, 0, 0]),
        (math.pi / 2, 0.0, [0, 1, 0]),
        (0.0, math.pi / 2, [0, 0, 1]),
    ],
)
def test_heading_and_pitch(heading: float, pitch: float, forward: list[float]) -> None:
    pose = Pose.looking(HERE, heading, pitch)
    np.testing.assert_allclose(pose.world_from_camera[:, 2], forward, atol=1e-12)
    np.testing.assert_allclose(pose.rt_matrix @ [*HERE, 1], 0, atol=1e-12)
    ahead = pose.rt_matrix @ [*(HERE + 2 * np.array(forward)), 1]
    np.testing.assert_allclose(ahead, [0, 0, 2], atol=1e-12)


def test_panorama_rays_are_the_sphere_mirrored_and_turned_by_the_heading() -> None:
    view = PanoramaView(Pose.looking(HERE, heading=0.7), 16)
    expected = equirect_directions((16, 32)) @ (rotation_about((0, 0, 1), 0.7) @ FLIP_Y).T
    np.testing.assert_allclose(view.rays(), expected, atol=1e-6)


def test_perspective_rays_project_to_their_pixels() -> None:
    view = PerspectiveView(Pose.looking(HERE, 0.4, 0.2, 0.1), 9, math.radians(60))
    rays = view.rays()
    projected = rays @ view.pose.world_from_camera @ view.camera_matrix.T
    pixels = projected[..., :2] / projected[..., 2:]
    columns, rows = np.meshgrid(np.arange(9), np.arange(9))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-4)
    np.testing.assert_allclose(rays[4, 4], view.pose.world_from_camera[:, 2], atol=1e-6)
    # The edge columns' outer sides span the field of view.
    edges = [view.rays(dx=dx)[4, j] for dx, j in ((-0.5, 0), (0.5, 8))]
    assert math.acos(float(edges[0] @ edges[1])) == pytest.approx(math.radians(60), abs=1e-3)


def test_views_look_around_as_asked() -> None:
    rng = np.random.default_rng(0)
    up = {
        kind: np.array(
            [draw_view(rng, kind, HERE, 8).pose.world_from_camera[2, 2] for _ in range(2000)]
        )
        for kind in ("uniform", "stanford")
    }
    # Archimedes: the height of uniform directions is uniform in [-1, 1], with variance 1/3.
    assert up["uniform"].var() == pytest.approx(1 / 3, abs=0.02)
    assert abs(up["uniform"].mean()) < 0.05
    assert np.degrees(np.arcsin(up["stanford"])).std() == pytest.approx(20, abs=1.5)
