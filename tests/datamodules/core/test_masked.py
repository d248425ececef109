"""`data.mask`: what does not count in training and evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datamodules import FolderPanoramas
from datamodules.core.pipeline import RotatedPanoramas
from datamodules.images.pixel_files import write_pixels
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.data_files import names_of
from tests.datamodules.folder.folder_format import CLASS_OF_STORED, write_data_set

SHAPE = (32, 64)
ERP: Any = EquirectRepresentation(level=4)
BELOW = 90 - (np.arange(32) + 0.5) * 180 / 32 < -30
"""Rows."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scenes of two panoramas; not to be changed."""
    return write_data_set(tmp_path_factory.mktemp("folder") / "data")


def stored_labels(root: Path, name: str) -> Any:
    """Decoded by another program."""
    stored = np.array(Image.open(root / "labels" / f"{name}.png"))
    return np.vectorize(CLASS_OF_STORED.get)(stored)


@pytest.mark.parametrize("settings", [{}, {"in_memory": True}, {"store": "store"}], ids=str)
def test_labels_are_unknown_there_and_pixels_stay(
    root: Path, settings: dict[str, Any], tmp_path: Path
) -> None:
    settings = {n: tmp_path if n == "store" else v for n, v in settings.items()}
    plain = FolderPanoramas(root, ERP, **settings)
    masked = FolderPanoramas(root, ERP, mask=-30, **settings)
    masked.prepare_data()
    prepared = sorted(tmp_path.rglob("*.npy"))
    plain.prepare_data()
    assert sorted(tmp_path.rglob("*.npy")) == prepared, "one store for both"
    for split in ("train", "val", "test"):
        for index, name in enumerate(names_of(masked, split)):
            expected = stored_labels(root, name)
            read, before = masked.source(split).read(index), plain.source(split).read(index)
            np.testing.assert_array_equal(before.labels, expected)
            expected[BELOW] = 0
            np.testing.assert_array_equal(read.labels, expected)
            np.testing.assert_array_equal(masked.source(split).labels(index), expected)
            np.testing.assert_array_equal(read.rgb, before.rgb)


def test_the_mask_rotates_with_the_panorama(root: Path, tmp_path: Path) -> None:
    """At the seam and the poles too: the mask has patches there."""
    patches = np.full((64, 128), 255, np.uint8)
    patches[:8, :40], patches[20:40, 120:], patches[20:40, :9], patches[50:, 30:90] = 0, 0, 0, 0
    write_pixels(tmp_path / "mask.png", patches)
    settings: Any = {"test_rotation": "so3", "seed": 3}
    masked = FolderPanoramas(root, ERP, mask=tmp_path / "mask.png", **settings)
    for index, name in enumerate(names_of(masked, "test")):
        expected = np.where(patches[1::2, 1::2], stored_labels(root, name), 0)
        # The output direction d shows the input at Rᵀd.
        rotation = RotatedPanoramas("so3", 3).rotation(index)
        x, y, z = np.moveaxis(equirect_directions(SHAPE) @ rotation, -1, 0)
        rows = (0.5 - np.arcsin(np.clip(z, -1, 1)) / np.pi) * 32
        columns = (np.arctan2(y, x) / np.pi + 1) * 32
        expected = expected[rows.astype(int).clip(0, 31), columns.astype(int) % 64]
        clear = np.minimum(abs(rows - rows.round()), abs(columns - columns.round())) > 1e-6
        found = masked.source("test").read(index).labels
        np.testing.assert_array_equal(found[clear], expected[clear])
        assert clear.mean() > 0.99


def test_missing_masks_are_listed_before_training(root: Path, tmp_path: Path) -> None:
    names = [path.relative_to(root / "labels") for path in (root / "labels").rglob("*.png")]
    for name in names:
        write_pixels(tmp_path / name, np.ones((16, 32), np.uint8))
    FolderPanoramas(root, ERP, mask=tmp_path).setup()
    (tmp_path / names[0]).unlink()
    (tmp_path / names[1]).unlink()
    module = FolderPanoramas(root, ERP, mask=tmp_path)
    problems, _ = module.check()
    assert problems.items == {name.with_suffix("").as_posix() for name in names[:2]}
    with pytest.raises(DataError, match=r"2 problems(.|\n)*found no such file; expected a mask"):
        module.setup()
