"""The smallest data set of panoramas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.data_module import data_set
from datamodules.core.files import ImageFiles, Split
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import LabelMap
from tangent_train.errors import SettingError
from tangent_train.rendering import EquirectRepresentation
from tests.datamodules.data_files import read_png, write_png


@data_set
class Toy(PanoramaDataModule):
    """Panoramas in one folder, the last of which is for the test."""

    label_maps = {"3": LabelMap.of(["sky", "wall", "ground"], [0])}  # noqa: RUF012

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """All but the last one are for training."""
        files = [
            ImageFiles(path.stem, path, self.root / "labels" / path.name)
            for path in sorted((self.root / "rgb").glob("*.png"))
        ]
        return {"train": files[:-1], "val": [], "test": files[-1:]}


def _toy(root: Path, **settings: Any) -> Toy:
    rng = np.random.default_rng(0)
    for folder, high, size in (("rgb", 255, (32, 64, 3)), ("labels", 3, (32, 64))):
        for name in "abc":
            image = rng.integers(0, high + 1, size, np.uint8)
            write_png(root / folder / f"{name}.png", image)
    given: Any = {"inputs": ["rgb"], "val_fraction": 0, **settings}
    return Toy(root, EquirectRepresentation(level=4), **given)


def test_a_data_set_is_its_files_and_classes(tmp_path: Path) -> None:
    data = _toy(tmp_path)
    data.prepare_data()
    assert len(data.dataset("train")) == 2
    (sample,) = data.dataset("test")
    np.testing.assert_array_equal(sample.labels, read_png(tmp_path / "labels" / "c.png"))
    problems, count = data.check()
    assert (problems.items, count) == (set(), 3)
    assert data.class_names == ("unknown", "sky", "wall", "ground")
    assert sum(data.label_counts["train"]) == 2 * 32 * 64


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inputs": ["rgb", "sound"]}, "data.inputs: found sound; expected 'rgb', 'depth' or"),
        ({"classes": 4}, "data.classes: found 4; expected 3"),
        ({"colour": 1}, "data.colour: found 1; expected a known setting"),
    ],
)
def test_settings_are_checked_by_their_types(
    tmp_path: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        _toy(tmp_path, **settings)
