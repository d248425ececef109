from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from benchmarks.processes import Process, interrupted_by_signals, run_processes


def _process(tmp_path: Path, name: str, code: str) -> Process:
    return Process(name, ("-c", code), tmp_path / f"{name}.txt")


def test_processes_run_some_at_once_and_tell_how_they_ended(tmp_path: Path) -> None:
    code = (
        "import os, pathlib, sys, time\n"
        f"mine = pathlib.Path({str(tmp_path)!r}, f'{{os.getpid()}}.running'); mine.touch()\n"
        "time.sleep(0.3); print(len(list(mine.parent.glob('*.running')))); mine.unlink()\n"
        "sys.exit(int(os.environ['STATUS']))"
    )
    ended: list[tuple[str, int]] = []
    run_processes(
        [_process(tmp_path, str(k), code) for k in range(5)],
        2,
        lambda process, status, _: ended.append((process.name, status)),
        {"STATUS": "3"},
    )
    assert sorted(ended) == [(str(k), 3) for k in range(5)]
    at_once = [int((tmp_path / f"{k}.txt").read_text()) for k in range(5)]
    assert max(at_once) == 2


def test_an_interruption_ends_all_processes_with_their_own(tmp_path: Path) -> None:
    code = (
        "import signal, subprocess, sys\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(child.pid, flush=True); child.wait()"
    )
    long, short = _process(tmp_path, "long", code), _process(tmp_path, "short", "pass")

    def interrupt(*_: object) -> None:
        while not long.log.read_text().strip():
            time.sleep(0.05)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_processes([long, short], 2, interrupt)
    child = Path(f"/proc/{long.log.read_text().strip()}/stat")
    for _ in range(100):
        if not child.exists() or child.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("a process is left")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_interrupt_and_are_given_back(number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_IGN)  # as of a command in the background
    try:
        with pytest.raises(KeyboardInterrupt), interrupted_by_signals():
            signal.raise_signal(number)
        assert signal.getsignal(number) == signal.SIG_IGN
    finally:
        signal.signal(number, before)
