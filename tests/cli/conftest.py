"""A run of a second, finished once for all tests of the commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.tiny_runs import SETTINGS, run_command


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where its rooms are."""
    folder = tmp_path_factory.mktemp("rooms") / "synthetic rooms"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        run_command(patch, "prepare", *SETTINGS, f"data.root='{folder}'")
    return f"data.root='{folder}'"


@pytest.fixture(scope="session")
def run_folder(rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_command(patch, "train", *SETTINGS, rooms, "hydra.run.dir=finished")
    return folder / "finished"
