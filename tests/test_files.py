from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

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
