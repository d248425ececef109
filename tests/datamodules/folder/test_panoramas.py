from __future__ import annotations

import re
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from datamodules.core.inputs import RGBD_NORMALIZATION, Normalization
from datamodules.folder.labeled import FolderPanoramas
from tangent_train.errors import SettingError
from tests.datamodules.data_files import read_png
from tests.datamodules.folder.folder_format import (
    CLASS_OF_STORED,
    NAMES,
    save,
    write_classes,
    write_panorama,
)

# Pixels


def test_pixels_are_those_of_the_files(root: Path, erp: Any) -> None:
    module = FolderPanoramas(root, erp, inputs=["rgb", "depth"], depth_units_per_m=2000)
    source = module.dataset("train")
    classes = np.zeros(256, np.uint8)
    classes[list(CLASS_OF_STORED)] = list(CLASS_OF_STORED.values())
    assert module.class_names == ("unknown", *NAMES)
    for index in range(len(source)):
        name = source.name(index)
        panorama = source.read(index)
        (path,) = (root / "images").glob(f"{name}.*")
        with Image.open(path) as image:
            rgb = np.asarray(image.convert("RGB"))
        mean = rgb.reshape(16, 2, 32, 2, 3).mean(axis=(1, 3))
        assert np.abs(panorama.rgb - mean).max() <= 0.5
        # The lower right of 2×2 pixels is nearest to the center, as for all data sets.
        stored = read_png(root / "labels" / f"{name}.png")
        np.testing.assert_array_equal(panorama.labels, classes[stored[1::2, 1::2]])
        units = read_png(root / "depth" / f"{name}.png")
        assert panorama.depth is not None
        meters = units[1::2, 1::2] / 2000
        assert np.abs(panorama.depth / 512 - meters).max() <= 0.5 / 512
        np.testing.assert_array_equal(source.labels(index), panorama.labels)


def _one_panorama(root: Path, stored: Image.Image, classes: Any, **settings: Any) -> None:
    """A data set whose only test panorama has these labels, the others having class 1."""
    write_classes(root, classes)
    for number in range(3):
        write_panorama(root, f"{number}", number, 16)
    stored.save(root / "labels" / "0.png", **settings)
    (root / "test.txt").write_text("0")


def _test_labels(root: Path, erp: Any) -> NDArray[np.uint8]:
    return FolderPanoramas(root, erp).dataset("test").read(0).labels


@pytest.mark.parametrize(("colors", "transparent"), [(4, False), (256, True)])
def test_palettes_are_entries_or_colors(
    tmp_path: Path, erp: Any, colors: int, transparent: bool
) -> None:
    rng = np.random.default_rng(colors)
    stored = rng.integers(0, colors, (16, 32), np.uint8)
    palette = np.stack((*np.divmod(np.arange(colors), 16), np.full(colors, 200)), -1)
    image = Image.fromarray(stored, "P")
    image.putpalette(palette.astype(np.uint8).tobytes())
    settings: dict[str, Any] = {"bits": {4: 2, 256: 8}[colors]}
    if transparent:
        settings["transparency"] = bytes(range(colors))
    _one_panorama(tmp_path, image, {"one": 1, "two": 2, "three": 3}, **settings)
    expected = np.where(stored < 4, stored, 0)
    np.testing.assert_array_equal(_test_labels(tmp_path, erp), expected)
    write_classes(tmp_path, {"two": "#0002c8", "three": "#0003C8"})
    expected = np.select([stored == 2, stored == 3], [1, 2])
    np.testing.assert_array_equal(_test_labels(tmp_path, erp), expected)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_colors_are_decoded_to_classes(tmp_path: Path, erp: Any, mode: str) -> None:
    rng = np.random.default_rng(0)
    gray = rng.choice(np.array([0, 17, 34, 255], np.uint8), (16, 32))
    rgb = np.repeat(gray[..., None], 3, axis=-1)
    if mode == "RGBA":
        rgb[..., 1] = rng.choice(np.array([0, 17], np.uint8), (16, 32))
    image = Image.fromarray(rgb).convert(mode)
    image.putalpha(Image.fromarray(rng.integers(0, 256, (16, 32), np.uint8)))
    _one_panorama(tmp_path, image, {"a": ["#000000", "#110011"], "b": "#111111", "c": "#ff11FF"})
    expected = np.zeros((16, 32), np.uint8)
    for color, label in {(0, 0, 0): 1, (17, 0, 17): 1, (17, 17, 17): 2, (255, 17, 255): 3}.items():
        expected[(rgb == color).all(-1)] = label
    np.testing.assert_array_equal(_test_labels(tmp_path, erp), expected)


# Settings


def test_normalization_is_by_the_inputs_or_ones_own(root: Path, erp: Any) -> None:
    both = FolderPanoramas(root, erp, inputs=["rgb", "depth"])
    assert both.normalization == RGBD_NORMALIZATION
    named = FolderPanoramas(root, erp, normalization="symmetric")
    assert named.normalization == Normalization((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    with pytest.raises(SettingError, match="normalization: found image; expected imagenet, unit"):
        FolderPanoramas(root, erp, normalization="image")


# Broken files


def test_files_that_cannot_be_used(own_root: Path, erp: Any) -> None:
    save(own_root / "labels/scene_1/view.1.png", np.zeros((32, 64, 3), np.uint8))
    write_panorama(own_root, "scene_2/view.1", 0, suffix=".jpg")
    (own_root / "depth/scene_3/view.1.png").unlink()
    save(own_root / "labels/scene_9/stray.png", np.zeros((32, 64), np.uint8))
    problems, _ = FolderPanoramas(own_root, erp, inputs=["rgb", "depth"]).check()
    found = {Path(p.file).parent.name: f"{p.finding}. {p.remedy}" for p in problems.listed()}
    assert found.keys() == {"scene_1", "scene_2", "scene_3"}
    assert found["scene_1"].startswith("colors; expected values of classes")
    assert found["scene_2"].startswith("another suffix; expected one image of each name")
    assert re.match(r"no such file; .*data\.inputs=\[rgb\]", found["scene_3"])
    assert problems.warnings == [f"{own_root}/labels: 1 without an image, e.g. scene_9/stray"]


# Names

NFC, NFD = (unicodedata.normalize(form, "küche/Tür") for form in ("NFC", "NFD"))
FOLDERS = ("images", "labels", "depth", "masks")


def _write_accents(root: Path) -> None:
    """Three panoramas with depth and masks, the first with a composed name."""
    write_classes(root)
    for number, name in enumerate((NFC, "b", "c")):
        write_panorama(root, name, number, 16, depth=True)
        save(root / "masks" / f"{name}.png", np.ones((16, 32), np.uint8))


@pytest.mark.parametrize("forms", [(NFC, NFD, NFC, NFD, NFD), (NFD, NFC, NFD, NFC, NFC)])
def test_names_that_look_the_same_are_the_same(
    tmp_path: Path, erp: Any, forms: tuple[str, ...]
) -> None:
    _write_accents(tmp_path)
    for folder, name in zip(FOLDERS, forms, strict=False):
        path = (tmp_path / folder / name).with_suffix(".png")
        content = (tmp_path / folder / NFC).with_suffix(".png")
        path.parent.mkdir(exist_ok=True)
        content.rename(tmp_path / "moved").rename(path)
    (tmp_path / "test.txt").write_text(f"{forms[-1]}\n", "utf-8")
    module = FolderPanoramas(tmp_path, erp, inputs=["rgb", "depth"], mask=tmp_path / "masks")
    assert module.check()[0].listed() == []
    assert module.dataset("test").name(0) == NFC
    assert module.dataset("test").read(0).labels.any()


def test_labels_of_other_classes_are_warned_of_in_training(
    tmp_path: Path, erp: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    write_classes(tmp_path, {"wall": 1, "door": 2})
    for number in range(3):
        write_panorama(tmp_path, f"{number}", number, 16)
        labels = np.where(np.arange(32) < 12, 1, 9) * np.ones((16, 1))
        save(tmp_path / "labels" / f"{number}.png", labels.astype(np.uint8))
    module = FolderPanoramas(tmp_path, erp)
    module.class_weights("none")
    assert capsys.readouterr().out == ""
    assert module.class_weights("log")[1] == 0
    assert capsys.readouterr().out == (
        "Warning: 62.5 % of the pixels for train are unknown.\n"
        "Warning: Classes without a pixel for train: door (1 of 2).\n"
    )
