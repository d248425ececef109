"""What processes that are killed leave behind, and who removes it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tangent_train import files
from tangent_train.files import write_text


@pytest.fixture(autouse=True)
def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if this process had not written anything yet."""
    monkeypatch.setattr(files, "_tidied", set())


def _age(path: Path, hours: float) -> None:
    then = time.time() - 3600 * hours
    os.utime(path, (then, then))


def test_old_temporary_files_are_removed_by_the_next_process(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / ".partial-folder").mkdir()
    for name in (".partial-old", ".partial-young", "inner/.partial-old"):
        (tmp_path / name).touch()
        _age(tmp_path / name, hours=25)
    _age(tmp_path / ".partial-folder", hours=25)
    _age(tmp_path / ".partial-young", hours=23)  # another machine may be writing it
    write_text(tmp_path / "a", "x")
    kept = {"a", "inner", ".partial-young", ".partial-folder"}
    assert {path.name for path in tmp_path.iterdir()} == kept
    assert (tmp_path / "inner" / ".partial-old").exists(), "only in the folder that is written to"
    (tmp_path / ".partial-old").touch()
    _age(tmp_path / ".partial-old", hours=25)
    write_text(tmp_path / "b", "x")
    assert (tmp_path / ".partial-old").exists(), "a folder is listed once, not for each file"


MAKER = """
import sys
from pathlib import Path
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings
print("begun", flush=True)
generate_rooms(Path(sys.argv[1]), RoomSettings(height=256), workers=2)
"""


@pytest.mark.parametrize(("how", "after_s"), [(signal.SIGTERM, 0.5), (signal.SIGKILL, 4)])
def test_workers_end_with_their_parent(tmp_path: Path, how: signal.Signals, after_s: float) -> None:
    """While they start and while they work; none keeps the pipe open."""
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
