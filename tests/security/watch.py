"""Sees what Python is asked to do: imports, files, processes, the network."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

from coverage import Coverage

from tests.security.attacks import CANARY

_MODULES = (CANARY, "antigravity", "collect_env")
_PROCESSES = ("os.exec", "os.posix_spawn", "os.spawn", "os.system", "subprocess.Popen")
_NETWORK = ("ftplib.connect", "http.client.connect", "socket.connect", "socket.getaddrinfo")
_watching: list[tuple[list[str], str]] = []


@contextmanager
def watched(forbidden: Path) -> Iterator[list[str]]:
    """Record forbidden events in a block.

    Args:
        forbidden: Folder that only attacks name; every access to it is recorded.

    Yields:
        Forbidden events.
    """
    happened: list[str] = []
    _watching.append((happened, str(forbidden)))
    try:
        yield happened
    finally:
        _watching.pop()


class _Finder(MetaPathFinder):
    """Sees `importlib.import_module` too, which raises no event."""

    def find_spec(self, name: str, *_: Any) -> None:
        _hook("import", (name,))


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    for happened, forbidden in _watching:
        imported = event == "import" and any(m in str(arguments[0]) for m in _MODULES)
        started = event in (*_PROCESSES, *_NETWORK)
        touched = event not in ("compile", "exec", "object.__getattr__") and any(
            isinstance(argument, str | Path) and forbidden in str(argument)
            for argument in arguments
        )
        if imported or started or touched:
            happened.append(f"{event} {str(arguments)[:200]}")


if sys.version_info < (3, 12) and Coverage.current() is not None:
    # Two threads that start at once would fail: "Cannot install a trace function …".
    raise RuntimeError("found coverage and an audit hook; run tests of `security` folders apart")
sys.meta_path.insert(0, _Finder())
sys.addaudithook(_hook)
