"""Spheres of shapes, prepared once: made in parallel, then read."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import closing
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console

from datamodules.core.processes import in_processes, number_of_processes
from datamodules.core.progress import show_progress
from datamodules.modelnet40.meshes import CHANNELS
from datamodules.modelnet40.sphere_files import is_current, make_sphere, read_sphere, stamp
from tangent_train.errors import DataError
from tangent_train.files import write_text
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from datamodules.modelnet40.shape_files import ShapeFile

__all__ = ["Shapes", "SphereFolder"]

_UNUSABLE = "unusable.json"
_PER_PROCESS = 40
_NAMED = 5


class Shapes:
    """Shapes of one split, by number.

    Args:
        names: A short name of each.
        labels: Its class, from 0.
        paths: Its prepared spheres.
        shape: ``(H, W)`` of the spherical images.
        in_memory: Whether to read all of them now and keep them: 12 bytes a pixel. Made before the
            loader's workers start, which then share the memory (on systems that fork).

    Attributes:
        labels: As given.
    """

    def __init__(
        self,
        names: Sequence[str],
        labels: Sequence[int],
        paths: Sequence[Path],
        shape: tuple[int, int],
        *,
        in_memory: bool = False,
    ) -> None:
        self._names = tuple(names)
        self.labels = tuple(labels)
        self._paths = tuple(paths)
        self._shape = shape
        self._kept = [read_sphere(path, shape) for path in paths] if in_memory else None

    def __len__(self) -> int:
        return len(self._names)

    def name(self, index: int) -> str:
        """Path of the mesh in the data set, without the suffix."""
        return self._names[index]

    def read(self, index: int) -> NDArray[np.uint16]:
        """The spherical images, ``(H, W, 6)`` in steps, not to be written to.

        Raises:
            DataError: The file is missing or broken.
        """
        if self._kept is not None:
            return self._kept[index]
        return read_sphere(self._paths[index], self._shape)

    def remembered(self) -> Shapes:
        """The same, kept in memory."""
        return Shapes(self._names, self.labels, self._paths, self._shape, in_memory=True)


class _Unusable(NamedTuple):
    """A mesh that cannot be used: what is wrong, and with which version of the file."""

    found: str
    stamp: str


class SphereFolder:
    """Where the prepared spheres of a data set are.

    Meshes that cannot be used are listed in ``unusable.json`` with what is wrong, and left out;
    like all others they are looked at again when their files change.

    Args:
        folder: The folder; made when there is something to write.
        shape: ``(H, W)`` of the spherical images.
    """

    def __init__(self, folder: Path, shape: tuple[int, int]) -> None:
        self.folder = folder
        self.shape = shape

    def path(self, mesh: ShapeFile) -> Path:
        """The file of a mesh, named as in the data set."""
        return self.folder / f"{mesh.name}.npy"

    def prepare(
        self, meshes: Sequence[ShapeFile], *, workers: int | None = None, progress: bool = True
    ) -> int:
        """Make the files that are missing, broken off or out of date.

        An interrupt leaves whole files only; the next call goes on.

        Args:
            meshes: Of what.
            workers: Processes; 0 and 1 work in this one. By default one per CPU core, fewer for
                little work.
            progress: Whether to show a progress bar, and what cannot be used.

        Returns:
            How many were made.

        Raises:
            DataError: The folder cannot be written to, or the disk is too full.
            SettingError: The number of workers is negative.
        """
        unusable = self._read_unusable()
        skipped = {mesh.name for mesh in meshes if self._is_known(mesh, unusable)}
        missing = [
            mesh
            for mesh in meshes
            if mesh.name not in skipped and not is_current(mesh.path, self.path(mesh))
        ]
        if missing:
            self._check_disk(len(missing))
            done = len(meshes) - len(missing)
            processes = number_of_processes(workers, len(missing), _PER_PROCESS)
            try:
                # Closed: an interrupt drops what is queued.
                with closing(self._make(missing, processes, unusable)) as making:
                    show_progress(
                        making, "Casting rays", "shapes", len(meshes), before=done, show=progress
                    )
            finally:
                self._write_unusable(unusable)
        if progress:
            self._report(meshes, unusable)
        return len(missing)

    def usable(self, meshes: Sequence[ShapeFile]) -> list[ShapeFile]:
        """Those of the meshes that were not found to be unusable."""
        unusable = self.unusable(meshes)
        return [mesh for mesh in meshes if mesh.name not in unusable]

    def unusable(self, meshes: Sequence[ShapeFile]) -> dict[str, str]:
        """The names of the others, and what was wrong with them."""
        listed = self._read_unusable()
        return {m.name: listed[m.name].found for m in meshes if self._is_known(m, listed)}

    def _make(
        self, meshes: Sequence[ShapeFile], processes: int, unusable: dict[str, _Unusable]
    ) -> Generator[None]:
        """Make files, and enter what cannot be used."""
        pieces = [(mesh, self.path(mesh), self.shape) for mesh in meshes]
        for mesh, found in in_processes(_make_one, pieces, processes):
            unusable.pop(mesh.name, None)
            if found is not None:
                unusable[mesh.name] = _Unusable(found, _stamp_or_none(mesh.path))
            yield

    def _is_known(self, mesh: ShapeFile, unusable: dict[str, _Unusable]) -> bool:
        entry = unusable.get(mesh.name)
        return entry is not None and entry.stamp == _stamp_or_none(mesh.path)

    def _read_unusable(self) -> dict[str, _Unusable]:
        path = self.folder / _UNUSABLE
        try:
            content: dict[str, Any] = parse_json(path.read_bytes())
            return {name: _Unusable(**entry) for name, entry in content.items()}
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise DataError(
                path,
                found=f"something else ({error})",
                expected="the list of unusable meshes",
                remedy="Remove it, then run tangent-prepare.",
            ) from error

    def _write_unusable(self, unusable: dict[str, _Unusable]) -> None:
        path = self.folder / _UNUSABLE
        content = {name: unusable[name]._asdict() for name in sorted(unusable)}
        if content:
            write_text(path, json.dumps(content, indent=1) + "\n")
        else:
            path.unlink(missing_ok=True)

    def _report(self, meshes: Sequence[ShapeFile], unusable: dict[str, _Unusable]) -> None:
        left_out = [mesh for mesh in meshes if self._is_known(mesh, unusable)]
        if not left_out:
            return
        lines = [f"{len(left_out)} of {len(meshes)} shapes cannot be used:"]
        lines += [f"  {unusable[mesh.name].found}" for mesh in left_out[:_NAMED]]
        lines.append(f"All are listed in {self.folder / _UNUSABLE}")
        Console(soft_wrap=True, highlight=False).print("\n".join(lines), markup=False)

    def _check_disk(self, count: int) -> None:
        folder = next(p for p in (self.folder, *self.folder.absolute().parents) if p.exists())
        if not folder.is_dir() or not os.access(folder, os.W_OK):
            kind = "a folder that may not be written to" if folder.is_dir() else "a file"
            raise DataError(
                folder,
                found=kind,
                expected="a folder for prepared spheres",
                remedy="Name another one in data.store.",
            )
        height, width = self.shape
        needed, free = count * (2 * CHANNELS * height * width), shutil.disk_usage(folder).free
        if needed > free:
            raise DataError(
                folder,
                found=f"{free / 1e6:.0f} MB free",
                expected=f"{needed / 1e6:.0f} MB for the spheres of {count} shapes",
                remedy="Free some space, or name a folder on another disk in data.store.",
            )


def _make_one(
    mesh: ShapeFile, target: Path, shape: tuple[int, int]
) -> tuple[ShapeFile, str | None]:
    return mesh, make_sphere(mesh.path, target, shape)


def _stamp_or_none(path: Path) -> str:
    try:
        return stamp(path)
    except OSError:  # a link that leads nowhere
        return "none"
