"""What processes that are killed leave behind, and who removes it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tangent_train import files
from tangent_train.files import atomic_path, write_text

if TYPE_CHECKING:
    from collections.abc import Iterator

SLOW_WRITER = """
import sys, time
from pathlib import Path
from tangent_train.files import atomic_path
with atomic_path(Path(sys.argv[1])) as temporary:
    temporary.write_text("half")
    print(temporary, flush=True)
    time.sleep(600)
"""


@pytest.fixture(autouse=True)
def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if this process had not written anything yet."""
    monkeypatch.setattr(files, "_tidied", set())


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A process in the middle of writing, and its temporary file."""
    with subprocess.Popen(
        [sys.executable, "-c", SLOW_WRITER, str(tmp_path / "file.txt")],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process, Path(process.stdout.readline().strip())
        process.kill()


def _age(path: Path, hours: float) -> None:
    then = time.time() - 3600 * hours
    os.utime(path, (then, then))


def test_what_a_killed_process_left_is_removed_by_the_next(
    tmp_path: Path, writer: tuple[subprocess.Popen[str], Path]
) -> None:
    process, temporary = writer
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert temporary.read_text() == "half"
    assert list(tmp_path.iterdir()) == [temporary], "no file that could be taken for a whole one"
    _age(temporary, hours=25)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / ".partial-x").touch()
    _age(tmp_path / "kept" / ".partial-x", hours=25)
    write_text(tmp_path / "file.txt", "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.txt", "kept"]
    assert (tmp_path / "kept" / ".partial-x").exists(), "only in the folder that is written to"


def test_what_is_young_may_be_of_another_machine(tmp_path: Path) -> None:
    (tmp_path / ".partial-young").touch()
    _age(tmp_path / ".partial-young", hours=23)
    (tmp_path / ".partial-folder").mkdir()
    _age(tmp_path / ".partial-folder", hours=25)
    write_text(tmp_path / "a", "x")
    assert {path.name for path in tmp_path.iterdir()} == {
        "a",
        ".partial-young",
        ".partial-folder",
    }


def test_a_folder_is_looked_at_once(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "x")
    (tmp_path / ".partial-old").touch()
    _age(tmp_path / ".partial-old", hours=25)
    with atomic_path(tmp_path / "b") as temporary:
        temporary.write_text("x")
    assert (tmp_path / ".partial-old").exists(), "thousands of files are not listed for each"


MAKER = """
import sys
from pathlib import Path
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings
print("begun", flush=True)
generate_rooms(Path(sys.argv[1]), RoomSettings(height=256), workers=2, progress=False)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("after_s", [0.5, 4])
def test_workers_end_with_their_parent(tmp_path: Path, how: signal.Signals, after_s: float) -> None:
    """While they start and while they work: none keeps the terminal's pipe open."""
    with subprocess.Popen(
        [sys.executable, "-c", MAKER, str(tmp_path / "rooms")],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"begun\n"
        time.sleep(after_s)
        process.send_signal(how)
        process.wait(10)
        ready, _, _ = select.select([process.stdout], [], [], 30)
        assert ready, "nothing ends"
        process.stdout.read()  # to the end: all who could write have ended


def test_files_are_on_the_disk_before_they_replace_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, Path.replace
    sizes: list[int] = []

    def noted_fsync(handle: int) -> None:
        done.append("fsync")
        sizes.append(os.fstat(handle).st_size)
        fsync(handle)

    def noted_replace(self: Path, target: Path) -> Path:
        done.append("replace")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(Path, "replace", noted_replace)
    write_text(tmp_path / "a", "four")
    assert done == ["fsync", "replace", "fsync"], "the file, then the names in its folder"
    assert sizes[0] == 4


ELSEWHERE = """
import os, sys
sys.modules["fcntl"] = None
del os.posix_fallocate
import numpy as np
from pathlib import Path
from tangent_train.cli import transfer_stages
from tangent_train.files import reserve, write_text
write_text(Path("a.txt"), "x")
array = np.lib.format.open_memmap("a.npy", "w+", np.float32, (100_000,))
array[:3] = 1, 2, 3
array.flush()
with open("a.npy", "r+b") as file:
    reserve(file, os.path.getsize("a.npy"))
assert np.load("a.npy")[:4].tolist() == [1, 2, 3, 0]
"""


def test_no_module_of_one_system_is_needed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE],
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
