"""Data sets in user code: samples by index, whole images as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, RandomSampler

from datamodules import Stanford2D3DS, Stanford2D3DSPerspective, SynthShapes
from datamodules.core.labeled_images import LabeledImage
from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE
from datamodules.synthrooms.generate import RoomSettings, generate_rooms
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, perspective_directions
from tangent_train.rendering import PerspectiveRepresentation, TangentRepresentation

ROOMS = RoomSettings(
    seed=5, rooms={"1": 2, "5a": 1}, height=64, views_per_camera=2, view_size=32, supersample=1
)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("rooms")
    generate_rooms(root, ROOMS, workers=0)
    return root


def _data(root: Path, **settings: Any) -> Stanford2D3DS:
    return Stanford2D3DS(root, areas=("1", "5a"), level=5, **settings)


def test_the_representation_is_tangent_images_of_a_level(rooms: Path) -> None:
    data = _data(rooms)
    assert isinstance(data.representation, TangentRepresentation)
    assert (data.erp_height, data.representation.image_size) == (64, (32, 32))
    photos = Stanford2D3DSPerspective(rooms, areas=("1", "5a"), level=5)
    assert photos.representation.image_size == (16, 16)
    assert Stanford2D3DS(rooms).erp_height == 256
    assert SynthShapes(rooms / "shapes").erp_height == 64
    with pytest.raises(SettingError, match=r"data\.level: found 5; expected null"):
        Stanford2D3DS(rooms, PerspectiveRepresentation(5), level=5)


def test_samples_have_an_index_or_an_epoch_and_an_index(rooms: Path) -> None:
    representation = TangentRepresentation(0, 5, faces_per_panorama=2)
    data = Stanford2D3DS(rooms, representation, areas=("1", "5a"), val_fraction=0)
    for split, count in (("train", 2), ("test", 1)):
        samples: Any = data.dataset(split)  # type: ignore[arg-type]
        assert [sample.index for sample in samples] == list(range(count)) == list(range(count))
        assert samples[-1].index == count - 1
        with pytest.raises(IndexError):
            samples[count]
    with pytest.raises(SettingError, match="split: found trian; expected train, val, test"):
        data.dataset("trian")  # type: ignore[arg-type]
    samples = data.dataset("train")
    assert torch.equal(samples[1].labels, samples[0, 1].labels)
    assert not torch.equal(samples[1].images[0], samples[1, 1].images[0])
    loader = DataLoader(samples, batch_size=2, sampler=RandomSampler(samples))
    (batch,) = loader
    assert sorted(batch.index.tolist()) == [0, 1]
    assert batch.images[0].shape == (2, 2, 32, 32, 3)
    assert data.normalized(batch).shape == (2, 2, 4, 32, 32)


def _agreement(panorama: LabeledImage, image: LabeledImage, directions: NDArray[Any]) -> float:
    """Share of the points of an image that a panorama of the same camera sees as they are."""
    assert panorama.pose is not None
    assert image.pose is not None
    assert panorama.distance_m is not None
    assert image.distance_m is not None
    known = np.isfinite(image.distance_m)
    assert known.mean() > 0.8
    points = image.pose.points_m(directions[known], image.distance_m[known])
    seen, distance_m = panorama.pose.project(points)
    row = (0.5 - np.arcsin(seen[..., 2]) / np.pi) * 64
    column = (0.5 + np.arctan2(seen[..., 1], seen[..., 0]) / (2 * np.pi)) * 128
    place = row.astype(int).clip(0, 63), column.astype(int) % 128
    near = np.abs(panorama.distance_m[place] / distance_m - 1) < 0.1
    return float((near & (panorama.labels[place] == image.labels[known])).mean())


def test_panoramas_and_photos_have_labels_distances_and_poses(rooms: Path) -> None:
    (panorama,) = _data(rooms).panoramas("test")
    assert panorama.name.startswith("area_5a/")
    assert panorama.rgb.shape == (64, 128, 3)
    assert panorama.labels.dtype == np.uint8
    assert panorama.camera_matrix is None
    photos = Stanford2D3DSPerspective(rooms, areas=("1", "5a"), level=5).photos("test")
    assert [photo.name.rpartition("/")[0] for photo in photos] == [panorama.name] * 2
    for photo in photos:
        assert photo.camera_matrix is not None
        rays = perspective_directions(photo.camera_matrix, (32, 32)) @ CAMERA_FROM_SPHERE
        assert _agreement(panorama, photo, rays) > 0.8


def test_the_pose_of_a_rotated_panorama_is_rotated(rooms: Path) -> None:
    directions = equirect_directions((64, 128))
    (panorama,) = _data(rooms).panoramas("test")
    (rotated,) = _data(rooms, test_rotation="so3").panoramas("test")
    assert _agreement(panorama, panorama, directions) == 1
    assert _agreement(panorama, rotated, directions) > 0.8


def test_missing_depth_and_poses_are_nan_or_null(stanford_root: Path) -> None:
    panorama = Stanford2D3DS(stanford_root, level=3).panoramas("test")[0]
    assert panorama.pose is None
    assert panorama.distance_m is not None
    np.testing.assert_array_equal(np.isnan(panorama.distance_m), panorama.labels == 0)
    colors = Stanford2D3DS(stanford_root, level=3, inputs=["rgb"]).panoramas("train")
    assert colors[-1].distance_m is None
    assert len(colors) == 8
