"""No pickle is loaded: a file with one that would create another file creates nothing."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from models.pretrained import read_tensors
from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import DataError
from tangent_train.heads import ClassesHead
from tangent_train.io.image_files import short_names
from tangent_train.io.jobs import Job
from tangent_train.io.pixel_files import read_image_size, write_pixels
from tangent_train.results.predictions import PredictionFolder
from tests.cli.tiny_runs import run_command
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
    content = {"state_dict": {}, "callbacks": Creating(created)}
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


@pytest.mark.parametrize("make", CREATORS)
def test_no_reader_unpickles(make: Any, created: Path, tmp_path: Path) -> None:
    readers: tuple[Any, ...] = (
        load_network,
        read_tensors,
        read_image_size,
    )
    for name in NAMES:
        path = tmp_path / name
        make(path, created)
        for read in readers:
            with pytest.raises(DataError):
                read(path)
            assert not created.exists()


_PARTS = st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=12)


@given(st.lists(st.lists(_PARTS, min_size=1, max_size=4), min_size=1, max_size=4))
@example([["..", "..", "etc", "x.png"], ["a", "..", "..", "b"]])
@example([["..x"], ["...", "x"]])
def test_predictions_stay_in_their_folder(names: list[list[str]]) -> None:
    paths = [Path("images", *parts) for parts in names]
    head = ClassesHead(("unknown", "wall"))
    folder = PredictionFolder(Path("/output"), head, ("labels", "probabilities"))
    for name in short_names(paths):
        for file in folder.files(Job(name, Path())).values():
            assert file.is_relative_to("/output")
            assert ".." not in file.parts


def test_names_in_a_list_of_cameras_lead_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crafted cameras.json beside tangent images, which are then rendered again and put back."""
    monkeypatch.chdir(tmp_path)
    write_pixels(tmp_path / "a.png", np.zeros((32, 64, 3), np.uint8))
    render = ["input=a.png", "output=tangent", "base_level=0", "level=4"]
    run_command(monkeypatch, "render", *render)
    file = tmp_path / "tangent" / "a" / "cameras.json"
    content = json.loads(file.read_text())
    precious = tmp_path / "precious.png"
    precious.write_bytes(b"mine")
    for image, name in zip(content["images"], ("../../precious.png", str(precious)), strict=False):
        image["file"] = name
    content["source"]["file"] = "../../../precious.png"
    file.write_text(json.dumps(content))
    with pytest.raises(SystemExit):
        run_command(monkeypatch, "render", "back=tangent/a", "output=back.png")
    run_command(monkeypatch, "render", *render)
    assert precious.read_bytes() == b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "precious.png", "tangent"]
