"""A small user-defined data set."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.datamodules.folder.folder_format import write_data_set


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scenes of two panoramas, 32×64; not to be changed."""
    return write_data_set(tmp_path_factory.mktemp("folder") / "data", depth=True)


@pytest.fixture
def own_root(root: Path, tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return Path(shutil.copytree(root, tmp_path / "data"))
