"""The working directory and the folder of compiled code may belong to somebody else."""

from __future__ import annotations

import os
from pathlib import Path

from tangent_train.imports import elsewhere, is_private
from tangent_train.rendering.compiled import cache_folder
from tests.running import Patch, run_python


def test_the_working_directory_is_kept_and_on_no_path_after_imports(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LD_LIBRARY_PATH", "/libraries")
    with elsewhere():
        assert Path.cwd() != tmp_path
        monkeypatch.setenv("LD_LIBRARY_PATH", ":/libraries:")  # as OpenCV does
    assert Path.cwd() == tmp_path
    assert os.environ["LD_LIBRARY_PATH"] == "/libraries"


def test_a_cache_is_used_if_only_its_owner_can_open_it(tmp_path: Path, monkeypatch: Patch) -> None:
    for mode, expected in ((0o750, False), (0o702, False), (0o700, True)):
        tmp_path.chmod(mode)
        assert is_private(tmp_path) == expected
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    assert not is_private(tmp_path)


COMPILED = """
import numpy as np
import tangent_train as tt
from tangent_train.rendering import compiled, kernels
grid = tt.TangentGrid(0, 5)
scores = np.zeros((20, 3, grid.dim, grid.dim), np.float32)
scores[:, 1] = 1
print(set(tt.tangent_to_labels(scores, grid, (16, 32)).ravel().tolist()))
loops = [value for value in vars(kernels).values() if hasattr(value, "stats")]
print(compiled.cache_folder(), {loop.stats.cache_path for loop in loops})
"""


def test_loops_are_compiled_where_no_folder_can_be_written(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "cache"))
    done = run_python(tmp_path, "-c", COMPILED)
    assert done.stdout.split("\n")[:2] == ["{1}", "None {None}"], done.stderr


def test_the_cache_is_a_private_folder(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = cache_folder()
    assert folder is not None
    assert folder.parent == tmp_path
    assert is_private(folder)
    folder.chmod(0o777)
    assert cache_folder() is None
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert cache_folder() == tmp_path / "user" / "tangent-train"
