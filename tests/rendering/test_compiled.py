"""The cache of compiled code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_LOOP = """
from typing import NamedTuple

from tangent_train.rendering.compiled import njit_exact


class {name}(NamedTuple):
    left: int
    right: int


@njit_exact
def add(pair):
    return pair.left + pair.right


print(add({name}(2, 3)))
"""


def test_code_compiled_from_an_earlier_source_file_is_not_read(tmp_path: Path) -> None:
    program = tmp_path / "loops.py"
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": paths}
    for name in ("Pair", "Couple"):  # the arguments' class is named in the cache
        program.write_text(_LOOP.format(name=name), encoding="utf-8")
        run = subprocess.run(
            [sys.executable, "-c", "import loops"],
            env={**os.environ, **environment, "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            check=False,
        )
        assert (run.returncode, run.stdout) == (0, b"5\n"), run.stderr
