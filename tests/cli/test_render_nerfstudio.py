"""Projects for Nerfstudio, read as its documentation describes them, without this package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from tangent_train.geometry import (
    PanoramaPose,
    equirect_directions,
    random_rotation,
    to_right_handed,
)
from tangent_train.io.camera_files import write_poses
from tangent_train.io.pixel_files import write_depth_m, write_pixels
from tests.cli.rendering import Refused, render_with
from tests.results.box_room import HIGHEST, LOWEST, colors_at, exit_points

SHAPE = (128, 256)
_RNG = np.random.default_rng(3)
POSES = {
    name: PanoramaPose(to_right_handed(random_rotation(_RNG)), location)
    for name, location in (("hall/a.png", (0.3, 0.2, -0.4)), ("b.png", (-0.6, 0.5, 0.1)))
}
"""Poses in the room, whose world is right-handed for this purpose."""


def _write_panoramas(folder: Path, poses: dict[str, PanoramaPose]) -> None:
    for name, pose in poses.items():
        rays = equirect_directions(SHAPE) @ pose.world_from_panorama.T
        points = exit_points(pose.location_m, rays)
        write_pixels(folder / "in" / name, np.rint(colors_at(points)).astype(np.uint8))
        distance = np.linalg.norm(points - pose.location_m, axis=-1)
        write_depth_m(folder / "depth" / name, distance, 1000)


def _frames(project: Path) -> list[dict[str, Any]]:
    """The frames, with the documented fields only and their files as arrays."""
    content = json.loads((project / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    for frame in content["frames"]:
        assert frame.keys() >= {"fl_x", "fl_y", "cx", "cy", "w", "h", "transform_matrix"}
        matrix = frame["transform_matrix"] = np.array(frame["transform_matrix"])
        assert matrix[3].tolist() == [0, 0, 0, 1]
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        for kind in ("file_path", "mask_path", "depth_file_path"):
            if kind in frame:
                frame[kind[:-5]] = cv2.imread(str(project / frame[kind]), cv2.IMREAD_UNCHANGED)
                assert frame[kind[:-5]].shape[:2] == (frame["h"], frame["w"])
    return list(content["frames"])


def _seen(frame: dict[str, Any], points: NDArray[np.float64]) -> tuple[Any, ...]:
    """Rows, columns and z-depth of points in a view, x right, y up, z back; and which it shows."""
    x, y, z = (np.linalg.inv(frame["transform_matrix"]) @ np.insert(points, 3, 1, axis=-1).T)[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = np.floor(frame["fl_x"] * x / -z + frame["cx"])
        rows = np.floor(frame["fl_y"] * y / z + frame["cy"])
    inside = (z < 0) & (rows >= 0) & (rows < frame["h"]) & (columns >= 0) & (columns < frame["w"])
    return rows[inside].astype(int), columns[inside].astype(int), -z[inside], inside


def test_points_of_a_room_are_in_their_pixels(tmp_path: Path) -> None:
    """Colors say where a point of the walls is; masks leave the south of the panoramas out."""
    _write_panoramas(tmp_path, POSES)
    write_poses(tmp_path / "poses.json", POSES)
    given = {"poses": tmp_path / "poses.json", "depth": tmp_path / "depth", "base_level": 0}
    mask = [-60, _mask(tmp_path)]
    render_with(input=tmp_path / "in", output=tmp_path / "out", nerfstudio=True, mask=mask, **given)
    frames = _frames(tmp_path / "out")
    assert len(frames) == 2 * 20
    rays = np.random.default_rng(0).normal(size=(4000, 3))
    points = exit_points(np.array([0.1, 0.1, 0.0]), rays)
    shown = 0
    for frame in frames:
        (name,) = {n for n in POSES if Path(frame["file_path"]).name == n.replace("/", "__")}
        rows, columns, depth, inside = _seen(frame, points)
        colors = frame["file"][rows, columns, ::-1]
        assert np.abs(colors - colors_at(points[inside])).mean() < 2
        assert np.median(np.abs(frame["depth_file"][rows, columns] / 1000 / depth - 1)) < 0.02
        shown += len(rows)
        directions, _ = POSES[name].project(points[inside])
        latitude = np.degrees(np.arcsin(directions[:, 2]))
        counts = frame["mask"][rows, columns] > 0
        assert not counts[latitude < -63].any()
        assert counts[(latitude > -57) & (latitude < 57)].all()
        assert not counts[latitude > 63].any()
    assert shown > 2 * len(points), "every panorama sees all walls"
    cloud = trimesh.load(tmp_path / "out" / "sparse_pc.ply")
    to_wall = np.abs(np.concatenate([cloud.vertices - LOWEST, HIGHEST - cloud.vertices], axis=-1))
    assert np.quantile(to_wall.min(axis=-1), 0.95) < 0.03
    assert np.abs(cloud.colors[:, :3] - colors_at(cloud.vertices)).mean() < 3
    assert len(cloud.vertices) > 10_000


def _mask(folder: Path) -> Path:
    """A mask whose pixels above 60° are black."""
    mask = np.full((36, 72), 255, np.uint8)
    mask[:6] = 0
    write_pixels(folder / "mask.png", mask)
    return folder / "mask.png"


def test_one_panorama_defines_the_world(tmp_path: Path, refused: Refused) -> None:
    """x ahead, y left, z up; several panoramas need poses, and those without one are left out."""
    identity = PanoramaPose(np.diag([1.0, -1, 1]), (0, 0, 0))
    _write_panoramas(tmp_path, {"a.png": identity})
    settings = {"nerfstudio": True, "yaw": 90, "fov": 90, "format": "jpg"}
    render_with(input=tmp_path / "in" / "a.png", output=tmp_path / "one", **settings)
    (frame,) = _frames(tmp_path / "one")
    # To the right: −y; the camera looks along its −z, up is y.
    np.testing.assert_allclose(-frame["transform_matrix"][:3, 2], (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(frame["transform_matrix"][:3, 1], (0, 0, 1), atol=1e-12)
    assert not (tmp_path / "one" / "sparse_pc.ply").exists()
    write_pixels(tmp_path / "in" / "c.png", np.zeros((8, 16, 3), np.uint8))
    message = refused(input=tmp_path / "in", output=tmp_path / "two", **settings)
    assert "poses: found null; expected poses of the 2 panoramas" in message
    write_poses(tmp_path / "poses.json", {"c.png": identity})
    settings["poses"] = tmp_path / "poses.json"
    render_with(input=tmp_path / "in", output=tmp_path / "two", **settings)
    assert [Path(f["file_path"]).name for f in _frames(tmp_path / "two")] == ["c.jpg"]
