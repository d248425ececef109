"""COLMAP reconstructs a project of overlapping panoramas; their poses come back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.synthrooms.furniture import build_room
from datamodules.synthrooms.render import (
    Camera,
    RayScene,
    View,
    draw_camera,
    draw_holes,
    render_picture,
)
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tests.cli.rendering import render_with
from tests.geometry.directions import angle_deg
from tests.keypoints.scenes import rotation_angle_deg

pycolmap = pytest.importorskip("pycolmap")
pycolmap.logging.minloglevel = 2


def _panoramas(folder: Path) -> dict[str, View]:
    """Three of 512 rows in one room, tilted by up to 11°, within 0.6 m of the first."""
    rng = np.random.default_rng(1)
    room = build_room(rng, "office")
    scene = RayScene(room)
    holes, first = draw_holes(scene), draw_camera(scene)
    poses = {}
    for k in range(3):
        place = first.location + (rng.uniform(-0.35, 0.35, 3) if k else 0)
        heading, (pitch, roll) = rng.uniform(-3, 3), rng.uniform(-0.2, 0.2, 2)
        view = View.looking(place, 512, heading=heading, pitch=pitch, roll=roll)
        camera = Camera(place, 0.0, (0.0, 0.0), first.gain, 0.004)
        picture = render_picture(scene, view, camera, holes, 1)
        write_pixels(folder / f"{k}" / "room.png", picture.rgb)
        poses[f"{k}/room.png"] = view
    return poses


def _options(kind: Any, **settings: Any) -> Any:
    options = kind()
    for name, value in settings.items():
        setattr(options, name, value)
    return options


def _reconstruct(project: Path) -> None:
    """The commands of docs/how-to/keypoints.md, in Python and with one thread."""
    database = project / "database.db"
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(
        database,
        project / "images",
        camera_mode=pycolmap.CameraMode.PER_FOLDER,
        reader_options=_options(pycolmap.ImageReaderOptions, mask_path=project / "masks"),
        extraction_options=_options(pycolmap.FeatureExtractionOptions, num_threads=1),
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config(pycolmap.read_rig_config(project / "rig_config.json"), opened)
    matching: dict[str, Any] = {"num_threads": 1, "skip_image_pairs_in_same_frame": True}
    pycolmap.match_exhaustive(
        database,
        matching_options=_options(pycolmap.FeatureMatchingOptions, **matching),
        device=pycolmap.Device.cpu,
    )
    (project / "sparse").mkdir()
    refined = ("focal_length", "extra_params", "sensor_from_rig")
    mapping: dict[str, Any] = {f"ba_refine_{name}": False for name in refined}
    mapping |= {"num_threads": 1, "random_seed": 0, "min_model_size": 3}
    options = _options(pycolmap.IncrementalPipelineOptions, **mapping)
    pycolmap.incremental_mapping(database, project / "images", project / "sparse", options)


def test_poses_of_a_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = _panoramas(tmp_path / "in")
    mask = np.full((512, 1024), 255, np.uint8)
    mask[427:] = 0  # below 60°: the tripod
    write_pixels(tmp_path / "mask.png", mask)
    project = tmp_path / "project"
    settings = {"base_level": 0, "colmap": True, "mask": tmp_path / "mask.png"}
    render_with(input=tmp_path / "in", output=project, **settings)
    _reconstruct(project)
    with pycolmap.Database.open(project / "database.db") as database:
        found = 0
        for image in database.read_all_images():
            counts = read_pixels(project / "masks" / f"{image.name}.png", indices=True)
            columns, rows = database.read_keypoints(image.image_id)[:, :2].astype(int).T
            assert (counts[rows, columns] == 255).all()
            found += len(rows)
        assert found > 10_000
    monkeypatch.chdir(project / "sparse")  # the project is two folders up of the model
    render_with(poses="0", output=tmp_path / "poses.json")
    entries = json.loads((tmp_path / "poses.json").read_text())["panoramas"]
    assert [entry["file"] for entry in entries] == list(poses)
    # A panorama's pose in the files: x forward, y left, z up; cameras: x right, y down, z forward.
    panorama_from_camera = np.array([[0, 0, 1.0], [-1.0, 0, 0], [0, -1.0, 0]])
    true = [pose.world_from_camera @ panorama_from_camera.T for pose in poses.values()]
    rotations: list[NDArray[np.float64]] = [np.array(e["world_from_panorama"]) for e in entries]
    lengths = []
    for k in (1, 2):
        assert np.linalg.det(rotations[k]) == pytest.approx(1)
        relative, expected = rotations[0].T @ rotations[k], true[0].T @ true[k]
        assert rotation_angle_deg(relative, expected) < 0.5
        shift = np.subtract(entries[k]["location"], entries[0]["location"]) @ rotations[0]
        first, other = (list(poses.values())[i].location for i in (0, k))
        expected_shift = (other - first) @ true[0]
        assert angle_deg(shift, expected_shift) < 0.5
        lengths.append(np.linalg.norm(shift) / np.linalg.norm(expected_shift))
    assert lengths[0] / lengths[1] == pytest.approx(1, abs=0.01)
