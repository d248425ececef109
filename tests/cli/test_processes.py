"""Runs as processes: they end with what started them, after a last checkpoint."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tangent_train.cli import processes
from tests.running import further_processes, has_ended, wait_for


def _python(code: str) -> list[str]:
    return [sys.executable, "-c", f"import os, signal, sys, time\n{code}"]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Short waits; a shell starts programs in the background deaf to Ctrl-C."""
    monkeypatch.setattr(processes, "_NOTICE_S", 0.1)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("name", "error"), [("SIGTERM", processes.SigtermError), ("SIGINT", KeyboardInterrupt)]
)
def test_a_signal_to_this_process_reaches_the_job_which_may_finish_its_checkpoint(
    name: str, error: type[BaseException], tmp_path: Path
) -> None:
    mark = tmp_path / "saved"
    code = (
        f"def save(*_): time.sleep(0.2); open({str(mark)!r}, 'w'); sys.exit(143)\n"
        "signal.signal(signal.SIGTERM, save)\n"
        f"time.sleep(0.5); os.kill(os.getppid(), signal.{name})\n"  # not while it is started
        "time.sleep(60)"
    )
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(error):
        processes.run_process(_python(code))
    assert mark.exists()
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.usefixtures("impatient")
def test_ctrl_c_ends_a_job_that_does_not_listen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "_CHECKPOINT_S", 0.3)
    number = tmp_path / "pid"
    code = (
        f"open({str(number)!r}, 'w').write(str(os.getpid()))\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "os.kill(os.getppid(), signal.SIGINT)\ntime.sleep(60)"
    )
    with pytest.raises(KeyboardInterrupt):
        processes.run_process(_python(code))
    with pytest.raises(ProcessLookupError):
        os.kill(int(number.read_text()), 0)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize("moment", ["at once", "waiting"])
def test_further_processes_of_a_run_end_with_a_killed_first_one(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They wait in C without a timeout, as for the others of a process group."""
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    mark = tmp_path / "begun"
    begin = "from tangent_train.cli.processes import end_with_first_process as begin\nbegin()\n"
    wait = f"open({str(mark)!r}, 'w')\nimport threading\nlock = threading.Lock()\n"
    further = _python(f"{begin}{wait}lock.acquire()\nlock.acquire()")
    start = f"import subprocess\nos.environ['LOCAL_RANK'] = '1'\nsubprocess.run({further})"
    with subprocess.Popen(_python(begin + start)) as first:
        wait_for(lambda: further_processes(first.pid))
        (other,) = further_processes(first.pid)
        if moment == "waiting":
            wait_for(mark.exists)
        first.kill()
        wait_for(lambda: has_ended(other))
