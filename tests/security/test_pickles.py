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


COMMANDS = {
    "evaluate": ["checkpoint={file}"],
    "predict": ["checkpoint={file}", "input=image.png", "output=labels"],
    "export": ["checkpoint={file}", "output=net.onnx"],
    "resume": ["resume=run"],
    "init_from": ["init_from={file}", "level=5"],
    "weights": ["network=fcn_resnet", "network.weights={file}", "level=4"],
    "transfer": ["experiment=rooms/transfer", "checkpoint={file}"],
    "keypoints": ["left={file}", "right={file}", "output=found"],
    "render": ["input={file}", "output=tangent"],
    "report": ["run"],
}


@pytest.mark.parametrize("what", COMMANDS)
def test_no_command_unpickles(
    what: str,
    created: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    file = Path("x.npy") if what == "render" else Path("x.ckpt")
    if what == "resume":
        file = Path("run/checkpoints/last.ckpt")
    if what == "report":
        file = Path("run/results.json")
    file.parent.mkdir(parents=True, exist_ok=True)
    _archive(tmp_path / file, created)
    (tmp_path / "image.png").touch()
    command = {"resume": "train", "init_from": "train", "weights": "train"}.get(what, what)
    with pytest.raises(SystemExit) as refused:
        run_command(monkeypatch, command, *(text.format(file=file) for text in COMMANDS[what]))
    assert not created.exists()
    message = str(refused.value) + capsys.readouterr().out  # which names one file of several
    assert file.name in message
    assert "found" in message
    assert "expected" in message


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
