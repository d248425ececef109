"""Distances as labels, of every data set with depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
import pytest
import torch
from numpy.typing import NDArray

from datamodules.cityscapes import Cityscapes
from datamodules.core.dataset import draw_rotation
from datamodules.core.image_module import ImageDataModule, PhotoDataModule
from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from datamodules.folder.labeled import FolderPanoramas
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS, Stanford2D3DSPerspective
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tests.conftest import fabricate
from tests.datamodules.data_files import read_png, write_png
from tests.datamodules.folder.folder_format import save, write_data_set

_AREAS = dict.fromkeys(("1", "2", "3", "4", "5a", "5b", "6"), ("office_1",))
UNEVEN = EquirectRepresentation(3, crop_deg=90, erp_height=16)
CROPS = PerspectiveRepresentation(5, fov_deg=25)


class Source(NamedTuple):
    """A data set whose depth files are overwritten with random numbers and holes.

    Attributes:
        module: Class of the data set.
        write: Function that writes its files.
        pattern: Depth files.
        settings: Further settings.
    """

    module: type[ImageDataModule]
    write: Callable[[Path], object]
    pattern: str
    settings: Mapping[str, Any] = {}


SOURCES = {
    "stanford2d3ds": Source(
        *(Stanford2D3DS, lambda root: fabricate(root, _AREAS, height=40)),
        "area_*/pano/depth/*.png",
    ),
    "folder": Source(
        *(FolderPanoramas, lambda root: write_data_set(root, scenes=5, height=40, depth=True)),
        "depth/*/*.png",
        {"depth_units_per_m": 250},
    ),
    "stanford2d3ds_perspective": Source(
        *(Stanford2D3DSPerspective, lambda root: fabricate(root, _AREAS, photos=1)),
        "area_*/data/depth/*.png",
    ),
}


def _overwrite(source: Source, root: Path) -> None:
    """Write random depth, a third of it missing."""
    for seed, path in enumerate(sorted(root.glob(source.pattern))):
        rng = np.random.default_rng(seed)
        stored = rng.integers(1, 65000, read_png(path).shape[:2], np.uint16)
        stored[rng.random(stored.shape) < 1 / 3] = 65535 if "Stanford" in str(source.module) else 0
        write_png(path, stored)


@pytest.fixture(scope="module", params=SOURCES)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A source and its files; not to be changed."""
    source, root = SOURCES[request.param], tmp_path_factory.mktemp("data") / "d"
    root.mkdir()
    source.write(root)
    _overwrite(source, root)
    return source, root


def _data(source: Source, root: Path, representation: Any = None, **changes: Any) -> Any:
    is_photos = issubclass(source.module, PhotoDataModule)
    given = {"labels": DISTANCE, "inputs": ["rgb"], **source.settings, **changes}
    return source.module(root, representation or (CROPS if is_photos else UNEVEN), **given)


def test_labels_are_the_depth_that_is_an_input_elsewhere(made: tuple[Source, Path]) -> None:
    """But for distances from 128 m, which 16 bits cannot hold; the tests of inputs have others."""
    source, root = made
    data = _data(source, root)
    assert (data.class_names, data.num_classes, "classes" in data.facts) == ((), 0, False)
    inputs = _data(source, root, labels=PIXEL_CLASSES, inputs=["rgb", "depth"]).dataset("test")
    distances = data.dataset("test")
    assert len(distances) == len(inputs) > 0
    for number in range(len(distances)):
        labels, depth = distances.read(number).labels, inputs.read(number).depth
        np.testing.assert_array_equal(labels, np.where(depth < 65535, depth, 0))
        assert labels.dtype == np.uint16
        assert (labels > 2**11).any(), "labels are not classes"


def test_store_and_memory_equal_the_files(made: tuple[Source, Path], tmp_path: Path) -> None:
    source, root = made
    batches = []
    for settings in ({}, {"cache": tmp_path}, {"in_memory": True}):
        data = _data(source, root, **settings)
        data.prepare_data()
        training, test = data.dataset("train")[1, 0], data.dataset("test")[0]
        assert {training.labels.dtype, test.labels.dtype} == {torch.int32}
        batches.append((*training.images, training.labels, *test.images, test.labels))
    for others in batches[1:]:
        for one, other in zip(batches[0], others, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)
    data = _data(source, root, cache=tmp_path, in_memory=True, labels=PIXEL_CLASSES)
    data.prepare_data()
    target = data.dataset("test")[0].labels
    assert 0 < target.max() < 50
    target.zero_()
    assert data.dataset("test")[0].labels.max() > 0, "a copy of what is in memory"
    assert len(list(tmp_path.iterdir())) == 2


def _pixels(
    directions: NDArray[np.float64], height: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of a panorama at directions ``(…, 3)``."""
    x, y, z = np.moveaxis(directions, -1, 0)
    columns = np.floor((np.arctan2(y, x) / np.pi + 1) * height).astype(int) % (2 * height)
    rows = np.floor((0.5 - np.arcsin(np.clip(z, -1, 1)) / np.pi) * height).astype(int)
    return np.clip(rows, 0, height - 1), columns


def test_a_channel_of_depth_can_be_named(tmp_path: Path) -> None:
    for name in "abc":
        save(tmp_path / "images" / f"{name}.png", np.zeros((32, 64, 3), np.uint8))
        (tmp_path / "depth").mkdir(exist_ok=True)
        channels = {c: np.full((32, 64), i + 1, np.float32) for i, c in enumerate("RGB")}
        OpenEXR.File({}, channels).write(str(tmp_path / "depth" / f"{name}.exr"))
    erp: Any = EquirectRepresentation(4)
    problems, _ = _data(SOURCES["folder"], tmp_path, erp, val_fraction=0).check()
    assert len(problems.listed()) == 3
    assert all("data.depth_channel=: B, G, R" in one.remedy for one in problems.listed())
    data = _data(SOURCES["folder"], tmp_path, erp, val_fraction=0, depth_channel="G")
    assert data.dataset("test")[0].labels.unique().tolist() == [2 * 512]


# --- masks, rotation ---------------------------------------------------------------


@pytest.mark.parametrize("rotation", [None, "so3"])
def test_masked_and_rotated_distances_keep_their_values(
    tmp_path: Path, rotation: str | None
) -> None:
    source = SOURCES["stanford2d3ds"]
    fabricate(tmp_path, _AREAS)
    _overwrite(source, tmp_path)
    erp = EquirectRepresentation(4)
    changes: dict[str, Any] = {"mask": -30, "unknown": "any_black", "test_rotation": rotation}
    data = _data(source, tmp_path, erp, **changes)
    files = data.splits()["test"][0]
    expected = read_png(files.depth)  # in steps of 1/512 m
    expected[expected == 65535] = 0
    expected[np.deg2rad(90 - (np.arange(32) + 0.5) * 180 / 32) < np.deg2rad(-30)] = 0
    expected[(read_png(files.rgb)[..., :3] == 0).any(-1)] = 0
    if rotation:
        R = draw_rotation("so3", 0, 0)
        expected = expected[_pixels(equirect_directions((32, 64)) @ R, 32)]
    target = data.dataset("test")[0].labels.numpy()
    assert (target == expected).mean() > 0.99, "but for rounding at the borders of pixels"
    assert 0.2 < (target > 0).mean() < 0.5


# --- what cannot be used -------------------------------------------------------------------------


def test_unlikely_depth_is_warned_of_and_counted(tmp_path: Path) -> None:
    write_data_set(tmp_path, scenes=3, each=1, depth=True)
    for name, meters in (("scene_0", 0.01), ("scene_1", 0), ("scene_2", 120)):
        stored = np.full((32, 64), meters * 250, np.uint16)
        stored[:8] = 0
        write_png(tmp_path / "depth" / name / "view.0.png", stored)
    data = _data(SOURCES["folder"], tmp_path, val_fraction=0, labels=DISTANCE)
    problems, _ = data.check()
    near, none, far = sorted(problems.warnings)
    assert near.startswith(str(tmp_path / "depth/scene_0/view.0.png: median distance 0.00"))
    assert "scene_1/view.0.png: no distance below 128 m" in none
    assert "scene_2/view.0.png: median distance 120 m" in far
    counts = sum(data.label_counts.values())
    np.testing.assert_array_equal(counts, [(4096 - 2 * 1536 + 2048) // 4, 2 * 1536 // 4])


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Cityscapes, {}, "data.labels: found distance; .*disparities are not read"),
        (Stanford2D3DS, {"inputs": ["rgb", "depth"]}, "data.inputs: .*no depth: it is the target"),
    ],
)
def test_settings_without_a_meaning_for_distances_are_refused(
    kind: Any, settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=message):
        kind(tmp_path, **{"labels": DISTANCE, "inputs": ["rgb"], **settings})
