"""Files and child processes that killed processes leave behind."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tangent_train.files import write_text
from tests.running import ROOT

MAKER = """
import sys
from pathlib import Path
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.generate import RoomSettings
print("begun", flush=True)
generate_rooms(Path(sys.argv[1]), RoomSettings(height=256), workers=2)
"""


@pytest.mark.parametrize(("how", "after_s"), [(signal.SIGTERM, 0.5), (signal.SIGKILL, 4)])
def test_workers_end_with_their_parent(tmp_path: Path, how: signal.Signals, after_s: float) -> None:
    """While they start and while they work; none keeps the pipe open."""
    with subprocess.Popen(
        [sys.executable, "-c", MAKER, str(tmp_path / "rooms")],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
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
    replace = Path.replace

    def noted_replace(self: Path, target: Path) -> Path:
        done.append("replace")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", lambda _: done.append("fsync"))
    monkeypatch.setattr(Path, "replace", noted_replace)
    write_text(tmp_path / "a", "four")
    assert done == ["fsync", "replace", "fsync"], "the file, then the names in its folder"
