from __future__ import annotations

import argparse
import collections
import datetime
import os
import pickle
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, load_plain, read_json, write_text
from tangent_train.io.pixel_files import read_rgb


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a" / "file.txt"
    write_text(path, "old ü")

    def cut_off() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("cut off")

    with pytest.raises(RuntimeError, match="cut off"):
        cut_off()
    assert path.read_text(encoding="utf-8") == "old ü"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("kind", [DataError, SettingError])
def test_errors_say_everything_and_survive_another_process(kind: type[DataError]) -> None:
    error = kind("data.fold", found=4, expected="1, 2 or 3", remedy="Choose one of these.")
    message = "data.fold: found 4; expected 1, 2 or 3. Choose one of these."
    assert str(error) == message
    assert str(pickle.loads(pickle.dumps(error))) == message
    assert isinstance(error, ValueError)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
def test_pipes_and_circular_links_are_refused_at_once(tmp_path: Path) -> None:
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    for suffix in ("", ".png", ".exr", ".onnx", ".ckpt"):
        os.mkfifo(pipe.with_suffix(suffix))
        link.with_suffix(suffix).symlink_to(link.with_suffix(suffix))
    readers: list[tuple[Callable[[Path], Any], str]] = [
        *((read_rgb, suffix) for suffix in (".png", ".exr")),
        *((load_network, suffix) for suffix in (".onnx", ".ckpt")),
        (lambda path: read_json(path, "JSON"), ""),
        (lambda path: load_plain(path, "tensors"), ".ckpt"),
    ]
    for read, suffix in readers:
        for path, found in ((pipe, "a pipe, socket or device"), (link, "Too many levels")):
            with pytest.raises(DataError, match=found):
                read(path.with_suffix(suffix))


def test_published_files_with_plain_values_are_read(tmp_path: Path) -> None:
    """Scores, arguments and dates beside the tensors; a class is refused."""
    counts = collections.defaultdict(list, {"a": [1]})
    values = {
        "best": np.float64(0.5),
        "step": np.int64(3),
        "args": argparse.Namespace(lr=0.1, root=Path("runs/a")),
        "counts": counts,
        "order": collections.OrderedDict(a=1),
        "date": datetime.datetime(2024, 5, 1, tzinfo=datetime.UTC),
        "tensor": torch.ones(2),
    }
    torch.save(values, tmp_path / "net.pth")
    found = load_plain(tmp_path / "net.pth", "a file")
    assert found["args"].lr == 0.1
    assert str(found["args"].root) == "runs/a"
    for name in ("best", "step", "counts", "order", "date"):
        assert found[name] == values[name]
    torch.save({"a": Fraction(1, 2)}, tmp_path / "other.pth")
    with pytest.raises(DataError, match=r"fractions\.Fraction, a class"):
        load_plain(tmp_path / "other.pth", "a file")
