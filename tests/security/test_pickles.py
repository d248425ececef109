"""No pickle is loaded: a file with one that would create another file creates nothing."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datamodules.core.store import Store
from datamodules.images.pixel_files import read_array
from models.pretrained import read_tensors
from tangent_train.checkpoints.content import read_checkpoint
from tangent_train.checkpoints.trained import load_trained
from tangent_train.errors import DataError
from tests.inference.trained import write_checkpoint


class Creating:
    """Unpickled, it creates a folder."""

    def __init__(self, created: Path) -> None:
        self._created = created

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._created),)


def _archive(path: Path, created: Path) -> None:
    """A checkpoint that is right but for one entry."""
    whole = write_checkpoint(path.with_suffix(".whole"))
    content = torch.load(whole, weights_only=True)
    torch.save(content | {"callbacks": Creating(created)}, path)
    whole.unlink()


def _legacy(path: Path, created: Path) -> None:
    content = {"config": {}, "state_dict": {}, "callbacks": Creating(created)}
    torch.save(content, path, _use_new_zipfile_serialization=False)


def _pickle(path: Path, created: Path) -> None:
    path.write_bytes(pickle.dumps(Creating(created)))


def _array(path: Path, created: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.array([Creating(created)], object), allow_pickle=True)


CREATORS = (_archive, _legacy, _pickle, _array)
NAMES = ("x.ckpt", "x.pt", "x.pth", "x.onnx", "x.safetensors", "x.npy")


@pytest.fixture
def created(tmp_path: Path) -> Path:
    return tmp_path / "created"


def _read_store(path: Path) -> None:
    copy = path.with_name("copy.npy")
    copy.write_bytes(path.read_bytes())
    Store(path.parent).read("copy", {})


@pytest.mark.parametrize("make", CREATORS)
def test_no_reader_unpickles(make: Any, created: Path, tmp_path: Path) -> None:
    readers: tuple[Any, ...] = (
        load_trained,
        read_checkpoint,
        read_tensors,
        read_array,
        _read_store,
    )
    for name in NAMES:
        path = tmp_path / name
        make(path, created)
        for read in readers:
            with pytest.raises(DataError):
                read(path)
            assert not created.exists()
