"""Masks of panoramas: latitudes, files of any size, one for each; partial panoramas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datamodules.core.dataset import draw_rotation
from datamodules.folder.labeled import FolderPanoramas
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_directions
from tangent_train.io.gpano import PanoramaArea, read_area
from tangent_train.io.masks import Masks
from tangent_train.io.pixel_files import write_pixels
from tangent_train.rendering import EquirectRepresentation, rotate_equirect
from tests.datamodules.data_files import names_of
from tests.datamodules.folder.folder_format import CLASS_OF_STORED, write_data_set

WHOLE = read_area(Path("image"), (32, 64))


def spotted(rows: int, seed: int = 0) -> Any:
    """Pixels that count (not 0) and do not."""
    return np.random.default_rng(seed).integers(0, 3, (rows, 2 * rows), np.uint8) * 100


@pytest.mark.parametrize("rows", [31, 180])
@pytest.mark.parametrize("lowest_deg", [-60, -0.5])
def test_pixels_below_a_latitude_are_masked(rows: int, lowest_deg: float) -> None:
    counts = Masks(lowest_deg).read("a", read_area(Path("image"), (rows, 2 * rows)))
    z = equirect_directions((rows, 2 * rows))[..., 2]
    np.testing.assert_array_equal(counts == 255, z > np.sin(np.radians(lowest_deg)) - 1e-9)
    assert (counts[-1] == 0).all()


@pytest.mark.parametrize("rows", [16, 96])
def test_a_mask_of_any_other_size_is_sampled_at_the_centers_of_pixels(
    rows: int, tmp_path: Path
) -> None:
    pixels = spotted(rows)
    write_pixels(tmp_path / "mask.png", pixels)
    counts = Masks(str(tmp_path / "mask.png")).read("any", WHOLE)
    for row, column in np.ndindex(32, 64):
        source = int((row + 0.5) * rows / 32), int((column + 0.5) * rows / 32)
        assert counts[row, column] == (255 if pixels[source] else 0)


def test_every_panorama_has_its_own(tmp_path: Path) -> None:
    for seed, name in enumerate(("a", "kitchen/a")):
        write_pixels(tmp_path / f"{name}.png", spotted(32, seed))
    masks = Masks(tmp_path)
    for seed, name in enumerate(("a", "kitchen/a")):
        masks.check(name, WHOLE)
        found = masks.read(name, WHOLE)
        np.testing.assert_array_equal(found, np.where(spotted(32, seed), 255, 0))
    write_pixels(tmp_path / "square.png", np.ones((20, 20), np.uint8))
    for use in (masks.check, masks.read):
        with pytest.raises(DataError, match=r"square\.png: found 20 × 20 .*twice as wide as high"):
            use("square", WHOLE)


def test_parts_of_panoramas_across_the_seam_with_masks_of_the_part_or_the_whole(
    tmp_path: Path,
) -> None:
    """Ninety degrees around ±180°, from 45° up to the nadir."""
    area = read_area(Path("image"), (24, 16), (135, -135, -90, 45))
    assert area == PanoramaArea((32, 64), (8, 32), (56, 72), (24, 16))
    shown = np.zeros((32, 64), bool)
    shown[8:, 56:], shown[8:, :8] = True, True
    part, whole = spotted(16)[:12, :8].repeat(2, 0).repeat(2, 1), spotted(32)
    write_pixels(tmp_path / "part.png", part)
    write_pixels(tmp_path / "whole.png", whole)
    placed = np.zeros((32, 64), np.uint8)
    placed[8:, 56:], placed[8:, :8] = part[:, :8], part[:, 8:]
    latitudes = (90 - (np.arange(32) + 0.5) * 180 / 32)[:, None]
    for mask, expected in (
        (None, shown),
        (-45, shown & (latitudes > -45)),
        (tmp_path / "part.png", placed > 0),
        (tmp_path / "whole.png", shown & (whole > 0)),
    ):
        np.testing.assert_array_equal(Masks(mask).read("any", area) == 255, expected)


@pytest.mark.parametrize("mask", [60, float("nan")])
def test_no_such_latitude(mask: Any) -> None:
    with pytest.raises(SettingError, match=r"data\.mask: found .*above −90, at most 0"):
        Masks(mask, "data.mask")


def test_files_that_are_not_masks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"pole\.png: found no such file; expected a mask as PNG"):
        Masks(tmp_path / "pole.png")
    write_pixels(tmp_path / "pole.jpg", spotted(32))
    with pytest.raises(DataError, match=r"pole\.jpg: found JPEG or WebP, which blur masks"):
        Masks(tmp_path / "pole.jpg")
    (tmp_path / "broken.png").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"broken\.png: found no image"):
        Masks(tmp_path / "broken.png")


# --- data.mask ------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("settings", [{"in_memory": True}, {"cache": "cache"}], ids=str)
def test_labels_are_unknown_there_and_pixels_stay(
    root: Path, settings: dict[str, Any], tmp_path: Path
) -> None:
    settings = {n: tmp_path if n == "cache" else v for n, v in settings.items()}
    plain = FolderPanoramas(root, ERP, **settings)
    masked = FolderPanoramas(root, ERP, mask=-30, **settings)
    masked.prepare_data()
    prepared = sorted(tmp_path.rglob("*.npy"))
    plain.prepare_data()
    assert sorted(tmp_path.rglob("*.npy")) == prepared, "one cache for both"
    for split in ("train", "val", "test"):
        for index, name in enumerate(names_of(masked, split)):
            expected = stored_labels(root, name)
            read, before = masked.dataset(split).read(index), plain.dataset(split).read(index)
            np.testing.assert_array_equal(before.labels, expected)
            expected[BELOW] = 0
            np.testing.assert_array_equal(read.labels, expected)
            np.testing.assert_array_equal(masked.dataset(split).labels(index), expected)
            np.testing.assert_array_equal(read.rgb, before.rgb)


def test_the_mask_rotates_with_the_panorama(root: Path, tmp_path: Path) -> None:
    """At the seam and the poles too: the mask has patches there."""
    patches = np.full((64, 128), 255, np.uint8)
    patches[:8, :40], patches[20:40, 120:], patches[20:40, :9], patches[50:, 30:90] = 0, 0, 0, 0
    write_pixels(tmp_path / "mask.png", patches)
    settings: Any = {"test_rotation": "so3", "seed": 3}
    masked = FolderPanoramas(root, ERP, mask=tmp_path / "mask.png", **settings)
    for index, name in enumerate(names_of(masked, "test")):
        labels = np.where(patches[1::2, 1::2], stored_labels(root, name), 0).astype(np.uint8)
        expected = rotate_equirect(labels, draw_rotation("so3", 3, index), "nearest")
        np.testing.assert_array_equal(masked.dataset("test").read(index).labels, expected)


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
