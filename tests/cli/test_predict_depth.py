"""`tangent-predict` with a depth network: files, statistics, videos, shards."""

from __future__ import annotations

import csv
import math
import re
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from datamodules.core.inputs import RGB_NORMALIZATION
from tangent_train.geometry import PanoramaPose, equirect_directions
from tangent_train.heads.alignment import AlignedMosaic
from tangent_train.io.camera_files import write_poses
from tangent_train.io.pixel_files import read_depth_m, read_pixels, write_pixels
from tests.cli.tiny_runs import Predict
from tests.datamodules.data_files import read_png
from tests.inference.trained import sphere, write_checkpoint, write_depth_checkpoint
from tests.keypoints.colmap_models import write_model
from tests.results.box_room import exit_points
from tests.running import Capture

LEAST_M = 1.5


def _distances(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Distances that `network` estimates: 1.5 m where an image is not red, to 1.5 e m."""
    return LEAST_M * np.exp(rgb[..., 0] / 255)


@pytest.fixture
def network(tmp_path: Path) -> Path:
    """A network whose output, the logarithm of the distance, depends on the color of a pixel."""
    return _network(tmp_path / "depth.ckpt")


def _network(path: Path, slope: float = 1) -> Path:
    weight = torch.zeros(1, 3, 3, 3)
    weight[0, 0, 1, 1] = slope * RGB_NORMALIZATION.std[0]
    bias = torch.tensor([slope * RGB_NORMALIZATION.mean[0] + math.log(LEAST_M)])
    tensors = {"weight": weight, "bias": bias}
    return write_depth_checkpoint(path, tensors=tensors)


def _depth(path: Path) -> NDArray[np.float64]:
    return read_depth_m(path, 1000).astype(np.float64)


def test_files_of_a_panorama(
    tmp_path: Path, network: Path, predict: Predict, capsys: Capture
) -> None:
    """Below latitude −60°, rows from (90 + 60) / 180 · 64 = 53.3 on, pixels are masked."""
    rgb, output = sphere(64), tmp_path / "out"
    write_pixels(tmp_path / "in" / "hall.png", rgb)
    common = {"checkpoint": network, "mask": -60, "write": "[depth,color,points,normals]"}
    entry = predict(**common, points=3000)["hall"]["depth"]
    expected = _distances(rgb)
    expected[53:] = 0
    depth = _depth(output / "depth" / "hall.png")
    np.testing.assert_allclose(depth, expected, rtol=0.01)
    known = depth[depth > 0]
    assert entry["unit"] == "m"
    assert entry["nearest"] == pytest.approx(known.min(), abs=1e-3)
    assert entry["farthest"] == pytest.approx(known.max(), abs=1e-3)
    assert (entry["known"], entry["too_far"]) == (1, 0), "masked pixels do not count"
    # Red is 128 + 120 x, and x has the median 0 in the part of the sphere above a latitude.
    assert entry["median"] == pytest.approx(LEAST_M * math.exp(128 / 255), rel=0.01)
    assert entry["step_after"] < 0.01

    assert read_png(output / "color" / "hall.png").shape == (64 + 22, 128, 3)
    cloud = trimesh.load(output / "points" / "hall.ply")
    directions = equirect_directions((64, 128)).reshape(-1, 3) * (1, -1, 1)
    distance_m = np.linalg.norm(cloud.vertices, axis=-1)
    pixels = (cloud.vertices @ directions.T).argmax(axis=1)
    np.testing.assert_allclose(directions[pixels] * distance_m[:, None], cloud.vertices, atol=1e-6)
    np.testing.assert_allclose(distance_m, depth.reshape(-1)[pixels], atol=5.1e-4)
    np.testing.assert_array_equal(cloud.colors[:, :3], rgb.reshape(-1, 3)[pixels])
    assert len(set(pixels)) == len(pixels)
    assert 2900 < len(pixels) <= 3000
    normals = read_pixels(output / "normals" / "hall.exr", indices=False)
    np.testing.assert_array_equal(normals.any(axis=-1), depth > 0)
    at_points = normals.reshape(-1, 3)[pixels]
    stored = cloud.metadata["_ply_raw"]["vertex"]["data"]
    in_cloud = np.stack([stored[name] for name in ("nx", "ny", "nz")], axis=-1)
    np.testing.assert_allclose(in_cloud, at_points, atol=1e-6)
    assert (at_points * cloud.vertices).sum(axis=-1).max() < 0, "they face the center"
    picture = read_png(output / "normals" / "hall.png")[..., ::-1]
    np.testing.assert_allclose(picture[depth > 0] / 127.5 - 1, normals[depth > 0], atol=0.005)
    assert not picture[depth == 0].any()

    printed = capsys.readouterr().out
    assert "A panorama is predicted in 20 views" in printed
    assert "Mean over the images (depth in meters)" in printed
    assert re.search(rf"median, m +│ +{entry['median']:.3g} │", printed)
    with (output / "summary.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["unit"], row["median"]) == ("m", str(entry["median"]))
    assert not (output / "classes.json").exists()
    assert "hall" in (output / "report.html").read_text()


def test_the_sky_of_a_label_map_has_no_distance(
    tmp_path: Path, network: Path, predict: Predict
) -> None:
    """Together with a mask of the nadir."""
    write_pixels(tmp_path / "in" / "a.png", sphere(64))
    labels = np.full((64, 128), 2, np.uint8)
    labels[:20, :50] = 3
    write_pixels(tmp_path / "labeled" / "labels" / "a.png", labels)
    (tmp_path / "labeled" / "classes.json").write_text('{"wall": 2, "sky": 3}')
    masks = {"mask": f"[-60,{tmp_path / 'labeled'}]", "mask_classes": "[sky]"}
    predict(checkpoint=network, write="[depth]", **masks)
    unknown = labels == 3
    unknown[53:] = True
    np.testing.assert_array_equal(_depth(tmp_path / "out" / "depth" / "a.png") == 0, unknown)


@pytest.mark.parametrize("across", [{}, {"align_across": "frames"}])
def test_classes_of_a_network_have_no_distance(
    tmp_path: Path, network: Path, predict: Predict, across: dict[str, str]
) -> None:
    """A green part of a dark panorama, which has no distance, point and normal, up to its edge."""
    green, edge = np.zeros((64, 128), np.uint8), np.ones((7, 7), np.uint8)
    green[6:26, 20:70] = 1
    rgb = np.where(green[..., None] > 0, np.array([0, 250, 0]), sphere(64) // 4).astype(np.uint8)
    write_pixels(tmp_path / "in" / "a.png", rgb)
    write_pixels(tmp_path / "in" / "b.png", rgb)
    masks = {"mask": f"[-60,{write_checkpoint(tmp_path / 'net.ckpt')}]", "mask_classes": "[green]"}
    entries = predict(checkpoint=network, write="[depth,points,normals]", **masks, **across)
    for name in "ab":
        unknown = _depth(tmp_path / "out" / "depth" / f"{name}.png") == 0
        assert unknown[53:].all()
        assert unknown[cv2.erode(green, edge) > 0].all()
        assert not unknown[:53][cv2.dilate(green, edge)[:53] == 0].any()
        assert entries[name]["depth"]["known"] == 1, "masked pixels do not count"
        normals = read_pixels(tmp_path / "out" / "normals" / f"{name}.exr", indices=False)
        np.testing.assert_array_equal(normals.any(axis=-1), ~unknown)
        cloud = trimesh.load(tmp_path / "out" / "points" / f"{name}.ply")
        assert len(cloud.vertices) == (~unknown).sum()


@pytest.mark.parametrize(
    ("mask", "classes", "refused"),
    [
        ("net.ckpt", "[sky]", "mask_classes: found sky; expected of dark, green, bright"),
        ("net.ckpt", "null", "mask_classes: found null; expected of dark, green, bright"),
        ("depth.ckpt", "[sky]", "that predicts pixel_classes. mask=.*depth.ckpt masks classes"),
        ("rgbd.ckpt", "[green]", "mask: found .*rgbd.ckpt, a network that takes depth"),
    ],
)
@pytest.mark.usefixtures("network")
def test_other_networks_are_no_masks(
    tmp_path: Path, predict: Predict, mask: str, classes: str, refused: str
) -> None:
    write_checkpoint(tmp_path / "net.ckpt")
    write_checkpoint(tmp_path / "rgbd.ckpt", channels=4)
    write_pixels(tmp_path / "in" / "a.png", sphere(16))
    with pytest.raises(SystemExit, match=refused):
        predict(mask=mask, mask_classes=classes)


def test_frames_get_one_scale(
    tmp_path: Path, network: Path, predict: Predict, capsys: Capture
) -> None:
    """Brighter pictures of one room are predicted as larger; a folder of one has no neighbor."""
    rgb, offsets = sphere(64) // 2, {"a": 0, "b": 60, "c": 20}
    for name, offset in offsets.items():
        write_pixels(tmp_path / "in" / f"{name}.png", rgb + np.uint8(offset))
    write_pixels(tmp_path / "in" / "other" / "d.png", rgb)
    common = {"checkpoint": network, "align_across": "frames", "mask": -60}
    entries = predict(**common, write="[depth,points]")
    expected = _distances(rgb + np.uint8(20))  # the median scale stays
    for name, offset in offsets.items():
        depth = _depth(tmp_path / "out" / "depth" / f"{name}.png")
        np.testing.assert_allclose(depth[:53], expected[:53], rtol=0.02)
        assert not depth[53:].any()
        assert entries[name]["depth"]["scale"] == pytest.approx(
            math.exp((20 - offset) / 255), rel=0.01
        )
        assert entries[name]["depth"]["median"] == pytest.approx(np.median(depth), rel=0.05)
        assert entries[name]["depth"]["step_after"] < 0.01
        points = trimesh.load(tmp_path / "out" / "points" / f"{name}.ply").vertices
        farthest = np.linalg.norm(points, axis=-1).max()
        assert farthest == pytest.approx(entries[name]["depth"]["farthest"], rel=1e-3)
    assert entries["other/d"]["depth"]["scale"] is None
    printed = capsys.readouterr().out
    assert "One scale for 3 images" in printed
    assert "Nothing determines the scale of other/d" in printed
    # A further image changes the scales of all.
    write_pixels(tmp_path / "in" / "e.png", rgb + np.uint8(60))
    write_pixels(tmp_path / "in" / "f.png", rgb + np.uint8(60))
    assert predict(**common, write="[depth,points]")["a"]["depth"]["scale"] == pytest.approx(
        math.exp(60 / 255), rel=0.01
    )


POSES = {
    f"{name}.png": PanoramaPose(np.diag([1.0, -1, 1]), location)
    for name, location in (("a", (0.5, 0.2, 0)), ("b", (-0.4, -0.2, 0.1)))
}


def _box(pose: PanoramaPose) -> NDArray[np.float64]:
    """Distances in a box."""
    rays = equirect_directions((128, 256)) @ pose.world_from_panorama.T
    return np.linalg.norm(exit_points(pose.location_m, rays) - pose.location_m, axis=-1)


def _write_gray(path: Path, gray: NDArray[np.float64]) -> None:
    rgb = np.repeat(gray.round().clip(0, 255)[..., None], 3, axis=-1)
    write_pixels(path, rgb.astype(np.uint8))


def test_known_poses_give_their_unit(tmp_path: Path, predict: Predict, capsys: Capture) -> None:
    """A box that the network estimates 1.6 times too large, from two places in it."""
    for name, pose in POSES.items():
        _write_gray(tmp_path / "in" / name, 255 / 2 * np.log(_box(pose) * 1.6 / LEAST_M))
    write_poses(tmp_path / "poses.json", POSES)
    write_pixels(tmp_path / "in" / "elsewhere.png", sphere(64))
    given = {"align_across": tmp_path / "poses.json", "levels": 7, "write": "[depth]"}
    entries = predict(checkpoint=_network(tmp_path / "depth.ckpt", 2), **given)
    scales = [entries[name]["depth"]["scale"] for name in "ab"]
    np.testing.assert_allclose(scales, 1 / 1.6, rtol=0.05)
    assert entries["a"]["depth"]["unit"] == "unit of poses"
    assert entries["elsewhere"]["depth"]["unit"] == "m"
    assert entries["elsewhere"]["depth"]["scale"] is None
    title = "(depth in meters, depth in the unit of the poses)"
    assert title in " ".join(capsys.readouterr().out.split())
    assert title in (tmp_path / "out" / "report.html").read_text()


def test_points_of_a_model_give_their_unit(tmp_path: Path, predict: Predict) -> None:
    """A model of 5 units per meter, for a network that estimates distances up to a scale."""
    for name, pose in POSES.items():
        _write_gray(tmp_path / "in" / name, 40 * _box(pose))
    tensors = {"weight": torch.zeros(1, 3, 3, 3), "bias": torch.tensor([RGB_NORMALIZATION.mean[0]])}
    tensors["weight"][0, 0, 1, 1] = RGB_NORMALIZATION.std[0]
    path = tmp_path / "depth.ckpt"
    network = write_depth_checkpoint(path, tensors=tensors, depth_kind="relative_depth")
    scaled = {f: PanoramaPose(p.world_from_panorama, 5 * p.location_m) for f, p in POSES.items()}
    rng = np.random.default_rng(0)
    points = {f: 5 * exit_points(p.location_m, rng.normal(size=(99, 3))) for f, p in POSES.items()}
    model = write_model(tmp_path / "project", scaled, points)
    given = {"align_across": model, "views": "erp", "levels": 7, "write": "[depth,color]"}
    entries = predict(checkpoint=network, **given)
    for name, pose in POSES.items():
        depth = _depth(tmp_path / "out" / "depth" / name)
        np.testing.assert_allclose(np.median(depth / _box(pose)), 5, rtol=0.02)
        assert entries[name[0]]["depth"]["unit"] == "unit of poses"
    assert '"unit of poses"' in (tmp_path / "out" / "report.html").read_text()


def test_views_are_aligned_while_the_next_image_is_predicted(
    tmp_path: Path, network: Path, predict: Predict, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pixels(tmp_path / "in" / "hall.png", sphere(32))
    align, names = AlignedMosaic.pixels, []

    def pixels(mosaic: AlignedMosaic) -> torch.Tensor:
        names.append(threading.current_thread().name)
        return align(mosaic)

    monkeypatch.setattr(AlignedMosaic, "pixels", pixels)
    entry = predict(checkpoint=network, compile="{backend: eager}")["hall"]["depth"]
    assert entry["known"] == 1
    assert len(names) == 1
    assert names != ["MainThread"]


def test_a_part_of_a_panorama(tmp_path: Path, network: Path, predict: Predict) -> None:
    """Across the seam: files have the size of the part, points their place on the sphere."""
    rows, columns = np.arange(16, 48), np.r_[112:128, 0:16]
    write_pixels(tmp_path / "in" / "a.png", sphere(64)[rows][:, columns])
    area = {"area": "[135,-135,-45,45]", "fill": "edge", "write": "[depth,points]"}
    entry = predict(checkpoint=network, **area)["a"]["depth"]
    depth = _depth(tmp_path / "out" / "depth" / "a.png")
    np.testing.assert_allclose(depth, _distances(sphere(64))[rows][:, columns], rtol=0.02)
    assert entry["known"] == 1
    points = trimesh.load(tmp_path / "out" / "points" / "a.ply").vertices
    assert len(points) == depth.size, "fewer than 500 000 pixels"
    assert np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))).min() > 135


def test_photos_have_z_depth(tmp_path: Path, predict: Predict) -> None:
    """A wall at 2 m, for a network that returns the same z-depth everywhere."""
    tensors = {"weight": torch.zeros(1, 3, 3, 3), "bias": torch.tensor([2.0])}
    path = tmp_path / "net.ckpt"
    network = write_depth_checkpoint(path, tensors=tensors, depth_kind="metric_z")
    write_pixels(tmp_path / "in" / "a.png", sphere(64)[10:40, 20:70])
    how = {"projection": "perspective", "fov": 70, "write": "[depth,points]"}
    entry = predict(checkpoint=network, **how)["a"]["depth"]
    depth = _depth(tmp_path / "out" / "depth" / "a.png")
    np.testing.assert_allclose(depth, np.full((30, 50), 2.0), atol=0.02)  # few pixels
    assert (entry["nearest"], entry["farthest"]) == pytest.approx((2, 2), abs=0.02)
    points = trimesh.load(tmp_path / "out" / "points" / "a.ply").vertices
    np.testing.assert_allclose(points[:, 2], depth.reshape(-1), atol=5.1e-4)
    half = math.tan(math.radians(35)) * 49 / 50
    np.testing.assert_allclose(points[:, 0].max(), 2 * half, rtol=0.01)


def test_relative_depth_is_marked(
    tmp_path: Path, network: Path, predict: Predict, capsys: Capture
) -> None:
    relative = torch.load(network, weights_only=True)
    relative["tangent_train"]["depth_kind"] = "relative_depth"
    relative["state_dict"]["network.bias"] += 1  # positive
    torch.save(relative, tmp_path / "relative.ckpt")
    write_pixels(tmp_path / "in" / "a.png", sphere(32))
    entry = predict(checkpoint=tmp_path / "relative.ckpt", align="none")["a"]["depth"]
    assert entry["unit"] == "relative"
    assert entry["median"] == pytest.approx(1, rel=0.05)
    title = "relative: median distance 1"
    assert title in capsys.readouterr().out
    assert title in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("settings", "refused"),
    [
        ({"label_map": "ade20k_to_stanford2d3ds"}, "found a network that predicts distance"),
        ({"upright": "auto"}, "predicts distance; .*Use upright=pose"),
        (
            {"write": "[labels,color]"},
            "write: found labels; expected depth, color, normals, points for",
        ),
        ({"write": "[points]", "checkpoint": None}, "write: found points; expected labels, color"),
    ],
)
def test_settings_of_the_other_kind_of_network_are_refused(
    tmp_path: Path, network: Path, predict: Predict, settings: dict[str, Any], refused: str
) -> None:
    write_pixels(tmp_path / "in" / "a.png", sphere(16))
    given = {name: value for name, value in settings.items() if value is not None}
    given |= {} if "checkpoint" in settings else {"checkpoint": network}
    with pytest.raises(SystemExit, match=refused):
        predict(**given)
    assert not (tmp_path / "out").exists()
