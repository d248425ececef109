"""The files of prepared spheres: what a mesh looks like from outside, as NumPy arrays.

A file is a ``.npy`` file, which `numpy.load` reads, of the six channels of `mesh_spheres` as
``(H, W, 6)`` uint16 in steps of 1/16384; behind it follows a line of JSON that says what it was
made from. Distances reach to 1.99, so 15 bits hold all values with an error of at most 1/32768,
less than 2/10000 of a channel's standard deviation. Float16 would take as much space and be eight
times as coarse around 1, and OpenCV does not sample it.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import numpy as np

from datamodules.images.pixel_files import read_array
from datamodules.modelnet40.meshes import CHANNELS, clean_mesh, mesh_spheres, read_off
from tangent_train.errors import DataError
from tangent_train.files import atomic_path
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["STEPS", "is_current", "make_sphere", "mesh_problem", "read_sphere", "stamp"]

STEPS = 16384
"""Steps of the stored values in 1."""

_VERSION = 1
_TAIL = 256  # bytes that hold the line of JSON
_REMEDY = "Run tangent-prepare with the same settings of data: it makes what is missing."


def stamp(path: Path) -> str:
    """What tells a version of a file from others."""
    status = path.stat()
    return f"version {_VERSION} of {status.st_size} bytes of {status.st_mtime_ns} ns"


def make_sphere(source: Path, target: Path, shape: tuple[int, int]) -> str | None:
    """Make the file of a mesh.

    Args:
        source: The mesh, an OFF file.
        target: The file to write, whole or not at all.
        shape: ``(H, W)`` of the spherical images.

    Returns:
        What is wrong with the mesh, when it cannot be used; otherwise None.
    """
    try:
        # Asked before the file is read: a change meanwhile is noticed later.
        made_from = stamp(source)
        spheres = mesh_spheres(clean_mesh(read_off(source)), shape)
    except (OSError, DataError) as error:
        return _named(source, error)
    steps = np.rint(spheres * STEPS).astype(np.uint16)
    with atomic_path(target) as temporary, temporary.open("wb") as file:
        np.save(file, steps, allow_pickle=False)
        file.write(f"\n{json.dumps({'made from': made_from})}\n".encode())
    return None


def mesh_problem(source: Path) -> str | None:
    """What is wrong with a mesh, as `make_sphere` finds it; None where nothing is."""
    try:
        clean_mesh(read_off(source))
    except (OSError, DataError) as error:
        return _named(source, error)
    return None


def _named(source: Path, error: Exception) -> str:
    """An error that names its file."""
    return str(error) if str(error).startswith(str(source)) else f"{source}: {error}"


def is_current(source: Path, target: Path) -> bool:
    """Whether a file is there, whole, and of this version of the mesh."""
    try:
        with target.open("rb") as file:
            file.seek(-min(_TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
            line = file.read().rpartition(b"\n{")[2]
        return bool(parse_json(b"{" + line) == {"made from": stamp(source)})
    except (OSError, ValueError):
        return False


def read_sphere(path: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """The spherical images of a mesh, ``(H, W, 6)`` in steps.

    Args:
        path: The file.
        shape: ``(H, W)``.

    Raises:
        DataError: It is missing or broken.
    """
    try:
        steps: NDArray[np.uint16] = np.array(read_array(path))
    except DataError as error:
        raise DataError(
            path,
            found=f"nothing to read ({error.found})",
            expected="prepared spheres",
            remedy=_REMEDY,
        ) from error
    if steps.dtype != np.uint16 or steps.shape != (*shape, CHANNELS):
        raise DataError(
            path,
            found=f"{steps.dtype} {steps.shape}",
            expected=f"uint16 {(*shape, CHANNELS)}",
            remedy="Remove it, then run tangent-prepare.",
        )
    return steps
