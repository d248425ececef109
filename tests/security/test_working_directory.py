"""The working directory may belong to somebody else."""

from __future__ import annotations

import os
from pathlib import Path

from tangent_train.imports import elsewhere
from tests.running import Patch


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
