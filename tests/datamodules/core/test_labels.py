"""Sets of classes, against the keys of published readers (classes from 0, −1 ignored)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.cityscapes import Cityscapes
from datamodules.core.image_module import ImageDataModule
from datamodules.densepass import DensePASS
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS, Stanford2D3DSPerspective
from datamodules.synpass import SynPASS
from tests.conftest import fabricate

STREETS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 11, 12, 12, 12, -1, 12, 12]
SYNPASS = [2, 4, -1, 11, 5, 0, 0, 1, 8, 12, 3, 7, 10, -1, -1, -1, -1, 6, -1, -1, -1, 9]
PUBLISHED: list[tuple[type[ImageDataModule], str, list[int]]] = [
    (Cityscapes, "13", STREETS),
    (DensePASS, "13", STREETS),
    (SynPASS, "13", SYNPASS),
]


@pytest.mark.parametrize(("data", "name", "key"), PUBLISHED)
def test_a_set_is_the_published_one(data: type[ImageDataModule], name: str, key: list[int]) -> None:
    maps = data.label_maps
    every, some = next(iter(maps.values())), maps[name]
    value_of = {label: value for value, label in every.labels.items() if label}
    found = [some.labels[value_of[label]] for label in range(1, len(key) + 1)]
    assert found == np.add(key, 1).tolist()
    assert len(some.names) == max(key) + 1


def test_panoramas_and_photos_are_read_in_a_set(tmp_path: Path, erp: Any) -> None:
    root = fabricate(tmp_path / "data", photos=1)
    store = tmp_path / "store"
    for kind, representation in ((Stanford2D3DS, erp), (Stanford2D3DSPerspective, None)):
        given: Any = {"representation": representation, "inputs": ["rgb"], "cache": store}
        every, eight = kind(root, **given, level=None), kind(root, **given, classes=8)
        for data in (every, eight):
            data.prepare_data()
        assert (every.num_classes, eight.num_classes) == (13, 8)
        before, after = (data.dataset("test").read(1).labels for data in (every, eight))
        for label, class_name in enumerate(every.class_names):
            known = class_name in eight.class_names
            expected = eight.class_names.index(class_name) if known else 0
            assert (after[before == label] == expected).all()
        assert len(np.unique(after)) > 4
    assert len(list(store.iterdir())) == 4, "a cache for each set"
