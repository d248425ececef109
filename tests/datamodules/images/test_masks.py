"""Masks of panoramas: latitudes, files of any size, one for each; partial panoramas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.images.gpano import PanoramaArea, area_of_crop, whole_area
from datamodules.images.masks import Masks
from datamodules.images.pixel_files import write_pixels
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_directions

WHOLE = whole_area(Path("whole.png"), (32, 64))


def spotted(rows: int, seed: int = 0) -> Any:
    """Pixels that count (not 0) and do not."""
    return np.random.default_rng(seed).integers(0, 3, (rows, 2 * rows), np.uint8) * 100


@pytest.mark.parametrize("rows", [31, 32, 180])
@pytest.mark.parametrize("lowest_deg", [-60, -45.0, -0.5, 0])
def test_what_is_below_a_latitude(rows: int, lowest_deg: float) -> None:
    counts = Masks(lowest_deg).read("a", whole_area(Path("a.png"), (rows, 2 * rows)))
    z = equirect_directions((rows, 2 * rows))[..., 2]
    np.testing.assert_array_equal(counts == 255, z > np.sin(np.radians(lowest_deg)) - 1e-9)
    assert (counts[-1] == 0).all()


@pytest.mark.parametrize("rows", [16, 64, 96])
def test_a_mask_of_any_other_size_is_sampled_at_the_centres_of_pixels(
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
    for _ in range(2):
        for seed, name in enumerate(("a", "kitchen/a")):
            masks.check(name)
            found = masks.read(name, WHOLE)
            np.testing.assert_array_equal(found, np.where(spotted(32, seed), 255, 0))
    for use in (masks.check, lambda name: masks.read(name, WHOLE)):
        with pytest.raises(DataError, match=r"b\.png: found no such file; expected a mask as PNG"):
            use("b")
    write_pixels(tmp_path / "square.png", np.ones((20, 20), np.uint8))
    for use in (masks.check, lambda name: masks.read(name, WHOLE)):
        with pytest.raises(DataError, match=r"square\.png: found 20×20.*twice as wide as high"):
            use("square")


def test_parts_of_panoramas_across_the_seam_with_masks_of_the_part_or_the_whole(
    tmp_path: Path,
) -> None:
    """Ninety degrees around ±180°, from 45° up to the nadir."""
    area = area_of_crop((24, 16), (135, -135, -90, 45))
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


@pytest.mark.parametrize("mask", [60, -90, float("nan"), True, [1]])
def test_no_such_latitude(mask: Any) -> None:
    with pytest.raises(SettingError, match=r"data\.mask: found .*above −90, at most 0"):
        Masks(mask, "data.mask")


def test_files_that_are_no_masks(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"pole\.png: found no such file; expected a mask as PNG"):
        Masks(tmp_path / "pole.png")
    write_pixels(tmp_path / "pole.jpg", spotted(32))
    with pytest.raises(DataError, match=r"pole\.jpg: found JPEG or WebP, which blur masks"):
        Masks(tmp_path / "pole.jpg")
    (tmp_path / "broken.png").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"broken\.png: found no image"):
        Masks(tmp_path / "broken.png")
