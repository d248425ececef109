"""The smallest data set of panoramas, and what is refused of one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import datamodules
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.images import ImageFiles, PngReader
from datamodules.core.problems import Problems
from datamodules.core.splits import Split
from tangent_train.errors import DataError, SettingError
from tangent_train.io.pixel_files import read_pixels
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.data_files import read_png, write_png

FORMATS = {"rgb": (8, ("RGB",)), "labels": (8, ("gray",))}


class ToyReader(PngReader):
    formats = FORMATS

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        labels: NDArray[np.uint8] = read_pixels(files.parts["labels"], indices=True)
        return labels if shape is None else cv2.resize(labels, shape[::-1], interpolation=0)


@dataclass(kw_only=True, eq=False, repr=False)
class Toy(PanoramaDataModule):
    class_names = ("unknown", "sky", "wall", "ground")

    def find_images(self, problems: Problems) -> tuple[ToyReader, dict[Split, list[ImageFiles]]]:
        files = [
            ImageFiles(path.stem, path, self.root / "labels" / path.name)
            for path in sorted((self.root / "rgb").glob("*.png"))
        ]
        return ToyReader(), {"train": files[:-1], "val": [], "test": files[-1:]}


def _write(root: Path, largest: int) -> None:
    rng = np.random.default_rng(0)
    for folder, high, size in (("rgb", 255, (32, 64, 3)), ("labels", largest, (32, 64))):
        for name in "abc":
            image = rng.integers(0, high + 1, size, np.uint8)
            write_png(root / folder / f"{name}.png", image)


def _toy(root: Path) -> Toy:
    return Toy(root, EquirectRepresentation(level=4), inputs=["rgb"], val_fraction=0)


def test_a_data_set_is_a_reader_and_its_files(tmp_path: Path) -> None:
    _write(tmp_path, 3)
    data = _toy(tmp_path)
    data.prepare_data()
    assert len(data.source("train")) == 2
    samples: Any = data.dataset("test")
    sample = samples[0]
    assert len(samples) == 1
    np.testing.assert_array_equal(sample.target, read_png(tmp_path / "labels" / "c.png"))
    problems, count = data.check()
    assert not problems.items
    assert count == 3


def test_other_names_of_splits_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    splits: Any = {"train": [], "valid": [], "test": []}
    monkeypatch.setattr(Toy, "find_images", lambda *_: (ToyReader(), splits))
    with pytest.raises(SettingError, match="splits: found train, valid, test; expected train, val"):
        _toy(tmp_path).prepare_data()


def test_labels_past_the_classes_are_found(tmp_path: Path) -> None:
    _write(tmp_path, 4)
    data = _toy(tmp_path)
    problems, _ = data.check()
    assert problems.items == {"a", "b", "c"}
    with pytest.raises(DataError, match=r"labels/c\.png: found label 4; expected 0 .* to 3"):
        data.source("test").labels(0)


def test_data_sets_that_are_read_are_those_that_are_not_generated() -> None:
    read = {name for name in datamodules.__all__ if datamodules.is_read(f"datamodules.{name}")}
    generated = {"SynthRooms", "SynthRoomsPairs", "SynthRoomsPerspective", "SynthShapes"}
    assert read == set(datamodules.__all__) - generated
    assert not datamodules.is_read("mine.Toy")


@pytest.mark.parametrize(("names", "found"), [(("sky", "wall"), "sky first"), ((), "none")])
def test_the_first_class_is_the_unknown_one(
    tmp_path: Path, names: tuple[str, ...], found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _write(tmp_path, 2)
    data = _toy(tmp_path)
    monkeypatch.setattr(Toy, "class_names", names)
    with pytest.raises(SettingError, match=f"class_names of Toy: found {found}; expected unknown"):
        data.prepare_data()


def test_names_of_classes_are_lines_of_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others would make every checkpoint of a training unreadable."""
    _write(tmp_path, 2)
    data = _toy(tmp_path)
    monkeypatch.setattr(Toy, "class_names", ("unknown", "wall\x1b[2J"))
    message = r"class_names of Toy: found 'wall.x1b\[2J'; expected names without control"
    for use in (data.prepare_data, data.check_classes):
        with pytest.raises(SettingError, match=message):
            use()
    problems, _ = data.check()
    assert "expected names without control characters" in str(problems.listed())


def test_a_data_set_without_images_is_refused(tmp_path: Path) -> None:
    data = _toy(tmp_path / "nowhere")
    with pytest.raises(DataError, match="nowhere: found no such folder; expected panoramas"):
        data.prepare_data()
    assert data.check()[0]
