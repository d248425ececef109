"""Break files for as long as one likes: ``python -m tests.slow.fuzz --minutes 12 [target …]``.

Inputs come from the mutations of `tests.slow.fuzz.mutation`, by atheris (``pip install atheris``),
which keeps those that reach new code. Every target runs in a process of its own with limits of
memory and time. An input that ends otherwise than documented is saved, once for every place where
its error came from, with the error beside it.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import subprocess
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

_GIB = 1 << 30
_SECONDS_PER_INPUT = 20
_MEMORY_PER_INPUT = 300 << 20  # what images of `LARGEST_IMAGE` take, with some copies
_COUNTS = "counts.json"
_INPUTS_PER_PROCESS = 40_000  # decoders of images lose a few kilobytes with many a broken file
_KINDS = ("error", "crash", "oom", "timeout", "memory")


def main() -> int:
    """Try the targets one after the other; 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.slow.fuzz", description=__doc__)
    parser.add_argument("target", nargs="*", help="all by default")
    parser.add_argument("--minutes", type=float, default=1.0, help="of each target")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="for what is found")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    try:
        atheris = importlib.import_module("atheris")
    except ImportError:
        parser.error("this needs atheris: pip install atheris")
    if arguments.child:
        _fuzz(atheris, arguments.target[0], arguments.minutes * 60, arguments.out)
    from tests.slow.fuzz.targets import TARGETS

    unknown = sorted(set(arguments.target) - set(TARGETS))
    if unknown:
        parser.error(f"no target {unknown[0]}; there are {', '.join(TARGETS)}")
    return max(
        _campaign(name, 60 * arguments.minutes, arguments.out / name)
        for name in arguments.target or TARGETS
    )


def _campaign(name: str, seconds: float, folder: Path) -> int:
    """Run the process of a target again and again; 1 where something was found."""
    (folder / "corpus").mkdir(parents=True, exist_ok=True)
    before = _findings(folder)
    end = time.monotonic() + seconds
    total: Counter[str] = Counter()
    slowest, ended = 0.0, 0
    while (left := end - time.monotonic()) > 1:
        (folder / _COUNTS).write_text('{"inputs": 0, "refused": 0, "slowest": 0}')
        command = [sys.executable, "-m", "tests.slow.fuzz", "--child", name]
        command += ["--minutes", str(left / 60), "--out", str(folder)]
        with (folder / "log.txt").open("a") as log:
            code = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
        counts = json.loads((folder / _COUNTS).read_text())
        slowest = max(slowest, counts.pop("slowest"))
        total.update(counts)
        if code:
            ended += 1
            _say(f"{name}: the process ended with {code}; see {folder / 'log.txt'}")
    found = sorted(_findings(folder) - before)
    _say(
        f"{name}: {total['inputs']} inputs in {seconds:.0f} s, {total['refused']} refused, "
        f"slowest {slowest:.2f} s; {len(found)} found"
    )
    for path in found:
        _say(f"  {path}")
    return 1 if found or ended else 0


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _findings(folder: Path) -> set[Path]:
    return {path for kind in _KINDS for path in folder.glob(f"{kind}-*")}


def _fuzz(atheris: Any, name: str, seconds: float, folder: Path) -> None:
    """Try inputs until the time is over; ends the process."""
    with atheris.instrument_imports(include=["datamodules", "tangent_train"]):
        from datamodules.images.image_opening import MOST_PIXELS
        from tests.slow.fuzz.targets import LARGEST_IMAGE, TARGETS
    target = TARGETS[name]
    seeds = target.seeds()
    for number, seed in enumerate(seeds):
        (folder / "corpus" / f"seed-{number}").write_bytes(seed)
    counts = {"inputs": 0, "refused": 0, "slowest": 0.0}
    path = folder / "tried" / "file.png"
    path.parent.mkdir(exist_ok=True)

    def try_one(content: bytes) -> None:
        start, used = time.monotonic(), _most_used()
        try:
            counts["refused"] += target.try_on(path, content) == "refused"
        except Exception as error:
            _save(folder, content, error)
        if _most_used() - used > _MEMORY_PER_INPUT:
            (folder / f"memory-{_most_used() >> 20}-MiB").write_bytes(content)
        counts["inputs"] += 1
        if time.monotonic() - start > counts["slowest"]:
            counts["slowest"] = time.monotonic() - start
            (folder / "slowest").write_bytes(content)
        if counts["inputs"] % 100 == 0:
            (folder / _COUNTS).write_text(json.dumps(counts))

    def mutator(content: bytes, most: int, seed: int) -> bytes:
        rng = Random(seed)
        if rng.random() < 0.3:
            return atheris.Mutate(content, most)
        return target.broken(content, rng, seeds)[:most]

    os.environ[MOST_PIXELS] = str(LARGEST_IMAGE)
    _limit_memory()
    options = [f"-max_total_time={seconds:.0f}", f"-timeout={_SECONDS_PER_INPUT}"]
    options += [
        f"-artifact_prefix={folder}/",
        "-rss_limit_mb=3000",
        f"-runs={_INPUTS_PER_PROCESS}",
        "-max_len=1048576",
        "-len_control=0",
    ]
    atheris.Setup([name, *options, str(folder / "corpus")], try_one, custom_mutator=mutator)
    atheris.Fuzz()


def _most_used() -> int:
    """Bytes of memory this process has had at most."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    # Of addresses; libFuzzer limits what is used. Decoders may ask for the 4 GiB a length promises.
    limit = pages * os.sysconf("SC_PAGE_SIZE") + 6 * _GIB
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _save(folder: Path, content: bytes, error: BaseException) -> None:
    """Keep an input whose error comes from a new place."""
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if "/tests/slow/fuzz/" not in f.filename
    ]
    place = f"{Path(frames[-1].filename).stem}-{frames[-1].lineno}" if frames else "check"
    file = folder / f"error-{type(error).__name__}-{place}"
    if not file.exists():
        file.write_bytes(content)
        text = "".join(traceback.format_exception(error))
        (folder / f"why-{file.name}.txt").write_text(text, errors="backslashreplace")


if __name__ == "__main__":
    sys.exit(main())
