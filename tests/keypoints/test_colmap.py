"""Databases for COLMAP, read back by COLMAP, which also reconstructs the cameras from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tangent_train.geometry import PanoramaPose, random_rotation, to_right_handed
from tangent_train.keypoints.colmap import add_pair
from tangent_train.keypoints.two_view import estimate_two_view
from tests.geometry.directions import random_directions, unit
from tests.keypoints.scenes import keypoints_at

pycolmap = pytest.importorskip("pycolmap")
SHAPE = (512, 1024)
CAMERA_FROM_PANORAMA = np.array([[0, 1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points_m = random_directions(250, 4) * rng.uniform(1.5, 5, (250, 1))
    found, positions, pairs = [], [], {}
    for left in range(3):
        pose = PanoramaPose(to_right_handed(random_rotation(rng)), rng.normal(size=3) * 0.6)
        order = rng.permutation(250)
        seen_xyz = pose.project(points_m[order])[0] + rng.normal(size=(250, 3)) * 3e-4
        found.append(keypoints_at(unit(seen_xyz)))
        positions.append(np.argsort(order))
        for right in range(left):  # the order of names and of images differ
            matches = np.stack([positions[left], positions[right]], axis=1)
            both = found[left], found[right]
            rays = (side.directions_xyz[k] for side, k in zip(both, matches.T, strict=True))
            pairs[left, right] = matches, estimate_two_view(*rays)
            images_of_pair = [(f"room a/{k}.png", SHAPE) for k in (left, right)]
            for _ in range(2):  # added again it changes nothing
                path = tmp_path / "a" / "rooms.db"
                add_pair(path, images_of_pair, both, *pairs[left, right])
    axes = CAMERA_FROM_PANORAMA
    with pycolmap.Database.open(tmp_path / "a" / "rooms.db") as database:
        images = {image.name: image for image in database.read_all_images()}
        assert sorted(images) == [f"room a/{k}.png" for k in range(3)]
        (camera,) = database.read_all_cameras()
        assert (camera.model.name, camera.height, camera.width) == ("EQUIRECTANGULAR", *SHAPE)
        for k, points in enumerate(found):
            image_id = images[f"room a/{k}.png"].image_id
            stored = database.read_keypoints(image_id)
            # COLMAP's own rays of these pixels, from corners, are the keypoints' directions.
            rays = camera.cam_ray_from_img(stored[:, :2].astype(np.float64))
            np.testing.assert_allclose(rays @ axes, points.directions_xyz, atol=1e-5)
            descriptors = database.read_descriptors(image_id)
            assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
            np.testing.assert_array_equal(descriptors.data, points.descriptors)
        for (left, right), (matches, two_view) in pairs.items():
            ids = [images[f"room a/{k}.png"].image_id for k in (left, right)]
            np.testing.assert_array_equal(database.read_matches(*ids), matches)
            geometry = database.read_two_view_geometry(*ids)
            np.testing.assert_array_equal(geometry.inlier_matches, matches[two_view.inliers])
            assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED.value
            rotation = axes.T @ geometry.cam2_from_cam1.rotation.matrix() @ axes
            np.testing.assert_allclose(rotation, np.asarray(two_view.rotation, np.float64))
