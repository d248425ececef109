"""A flipped bit in the weights of a file is found, with the file's name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from models import initialize
from tangent_train.checkpoints.content import read_checkpoint
from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import DataError
from tests.cli.tiny_runs import run_command
from tests.inference.trained import color_network, write_checkpoint


def _flip(path: Path, number: bytes, bit: int) -> None:
    """Flip a bit of four bytes that are in a file once."""
    content = path.read_bytes()
    assert content.count(number) == 1
    flipped = (int.from_bytes(number, "little") ^ 1 << bit).to_bytes(4, "little")
    path.write_bytes(content.replace(number, flipped))


@pytest.mark.parametrize("bit", [0, 12, 31])
@pytest.mark.parametrize("name", ["x.ckpt", "x.safetensors", "x.onnx"])
def test_damaged_networks_are_refused(
    name: str, bit: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_checkpoint(tmp_path / "x.ckpt")
    if name != path.name:
        run_command(monkeypatch, "export", f"checkpoint={path}", f"output={name}")
        path = tmp_path / name
    load_network(path)
    weights = color_network().weight.detach()
    _flip(path, weights[1, 2, 0, 1].numpy().tobytes(), bit)
    found = rf"{name}: found a damaged file, whose checksum is wrong; .* Copy the original"
    with pytest.raises(DataError, match=found):
        load_network(path)
    if name == "x.ckpt":
        uses: tuple[Callable[[], Any], ...] = (
            lambda: read_checkpoint(path),
            lambda: initialize(color_network(), path),
        )
        for use in uses:
            with pytest.raises(DataError, match=found):
                use()


def test_a_resumed_run(
    run: Path, content: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in the state of the optimizer."""
    monkeypatch.chdir(run.parent)
    path = tmp_path / "theirs" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True)
    path.write_bytes((run / "checkpoints" / "last.ckpt").read_bytes())
    state = content["optimizer_states"][0]["state"][0]["exp_avg"]
    _flip(path, state.flatten()[5].numpy().tobytes(), 7)
    with pytest.raises(SystemExit, match=r"^tangent-train: .*last\.ckpt: found a damaged file"):
        run_command(monkeypatch, "train", f"resume={tmp_path}/theirs", "data.root=rooms")
