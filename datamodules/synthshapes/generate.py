"""Generating a data set: shapes in parallel, files whole or not at all, resumable."""

from __future__ import annotations

import os
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from datamodules.core.made_folders import claim_folder
from datamodules.core.processes import in_processes, number_of_processes
from datamodules.core.progress import show_progress
from datamodules.modelnet40.off_files import write_off
from datamodules.synthshapes.families import CLASSES, make_shape

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from datamodules.synthshapes.settings import ShapeSettings

__all__ = ["MANIFEST", "VERSION", "ShapePlan", "generate_shapes", "plan_shapes"]

MANIFEST = "synthshapes.json"
"""File that marks a folder as SynthShapes and holds its settings."""

VERSION = 1
"""Version of the generator; another one makes other shapes from the same settings."""

_PER_PROCESS = 200


class ShapePlan(NamedTuple):
    """A shape before it is made.

    Attributes:
        label: Its class.
        part: ``train`` or ``test``.
        number: From 1, unique in the class.
    """

    label: str
    part: str
    number: int

    @property
    def file(self) -> str:
        """Its path in the data set, as that of ModelNet40."""
        return f"{self.label}/{self.part}/{self.label}_{self.number:04d}.off"


def plan_shapes(settings: ShapeSettings) -> list[ShapePlan]:
    """All shapes of a data set: of each class those for training, then those for the test."""
    parts = ["train"] * settings.train + ["test"] * settings.test
    return [
        ShapePlan(label, part, number)
        for label in CLASSES
        for number, part in enumerate(parts, start=1)
    ]


def generate_shapes(
    root: Path, settings: ShapeSettings, *, workers: int | None = None, progress: bool = True
) -> None:
    """Write a data set in ModelNet40's tree; finished files are kept.

    The same settings give the same bytes for any number of workers, whether or not the work was
    interrupted. An interrupt leaves whole files only.

    Args:
        root: Folder of the data set: new, empty, or of the same settings.
        settings: What to make.
        workers: Processes; 0 and 1 work in this one. By default one per CPU core, fewer for little
            work.
        progress: Whether to show a progress bar.

    Raises:
        DataError: The folder holds other files, or shapes of other settings. Nothing is written.
        SettingError: The number of workers is negative.
    """
    plans = plan_shapes(settings)
    processes = number_of_processes(workers, len(plans), _PER_PROCESS)
    claim_folder(root, MANIFEST, "SynthShapes", VERSION, settings.as_dict())
    missing = [plan for plan in plans if not _is_whole(root / plan.file)]
    if not missing:
        return
    done = len(plans) - len(missing)
    with closing(_make(root, settings.seed, missing, processes)) as making:
        show_progress(making, "Making shapes", "shapes", len(plans), before=done, show=progress)


def _make(root: Path, seed: int, plans: list[ShapePlan], processes: int) -> Generator[None]:
    pieces = [(root, seed, plan) for plan in plans]
    return in_processes(_make_file, pieces, processes)


def _make_file(root: Path, seed: int, plan: ShapePlan) -> None:
    write_off(root / plan.file, make_shape(seed, plan.label, plan.number))


def _is_whole(path: Path) -> bool:
    """Whether a file is there and ends with a line."""
    try:
        with path.open("rb") as file:
            file.seek(-1, os.SEEK_END)
            return file.read() == b"\n"
    except OSError:
        return False
