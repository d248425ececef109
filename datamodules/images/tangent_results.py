"""What other programs made of tangent images, back on the panorama."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.lib.format import open_memmap

from datamodules.images.pixel_files import (
    LOSSY_SUFFIXES,
    READABLE_SUFFIXES,
    check_writable,
    read_pixels,
    write_pixels,
)
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, reserve
from tangent_train.geometry.resized_grid import ResizedGrid
from tangent_train.rendering import Blend, tangent_to_equirect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence, Set

    from numpy.typing import NDArray

    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering.camera_files import CameraFile

__all__ = ["KINDS", "Kind", "TangentResults", "result_files"]

Kind = Literal["color", "labels", "depth", "features"]
"""What pixels mean: colours and features are interpolated, labels and depth never mixed."""

KINDS: tuple[Kind, ...] = ("color", "labels", "depth", "features")

_GROUP_BYTES = 2**28
"""Channels are rendered together while their images take no more than this."""
_NO_DEPTH = 65535
"""Marks missing depth in many files of 16 bits; 0 does in all."""


def result_files(folder: Path, cameras: CameraFile) -> list[Path]:
    """The results for all images of a grid: files with the images' names and any suffix.

    Args:
        folder: Where they are.
        cameras: The images.

    Returns:
        One file for every image of the grid, in its order.

    Raises:
        DataError: Files are missing, stand there twice, or belong to no image.
    """
    grid = cameras.grid
    if len(cameras.faces) < grid.num_images:
        raise DataError(
            folder,
            found=f"cameras of {len(cameras.faces)} of the {grid.num_images} images",
            expected="all of them, to cover the whole sphere",
            remedy="Render the panorama without faces=….",
        )
    files: dict[str, list[Path]] = {}
    for file in sorted(folder.iterdir() if folder.is_dir() else ()):
        if file.suffix.lower() in READABLE_SUFFIXES and not file.name.startswith("."):
            files.setdefault(file.stem, []).append(file)
    stems = {Path(name).stem: face for name, face in zip(cameras.files, cameras.faces, strict=True)}
    _check_names(folder, files, stems.keys())
    by_face = {face: files[stem][0] for stem, face in stems.items()}
    return [by_face[face] for face in range(grid.num_images)]


def _check_names(folder: Path, files: Mapping[str, list[Path]], stems: Set[str]) -> None:
    expected = f"one file for each of the {len(stems)} images of its cameras, named as these"
    missing, unknown = sorted(stems - files.keys()), sorted(files.keys() - stems)
    if missing:
        found = f"no {_some(missing)}" + (f", but {_some(unknown)}" if unknown else "")
        raise DataError(folder, found=found, expected=expected)
    twice = [" and ".join(path.name for path in paths) for paths in files.values() if paths[1:]]
    if unknown or twice:
        raise DataError(
            folder,
            found=f"{_some(unknown)} as well" if unknown else twice[0],
            expected=expected,
            remedy="Results go into a folder of their own; cameras= says where their cameras are.",
        )


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" … ({len(names)} in all)" if len(names) > 3 else "")


@dataclass(frozen=True)
class TangentResults:
    """Results for all images of one panorama.

    Attributes:
        arrays: ``(d, d)`` or ``(d, d, C)`` for every image of the grid, all alike.
        grid: The geometry of the images the results were made of.
        kind: What the pixels mean.
    """

    arrays: Sequence[NDArray[Any]]
    grid: PinholeGrid
    kind: Kind

    @classmethod
    def read(
        cls, files: Sequence[Path], grid: PinholeGrid, kind: Kind | Literal["auto"]
    ) -> TangentResults:
        """Read and check them.

        Args:
            files: One for every image, in the order of the grid; from `result_files`.
            grid: The images.
            kind: ``auto`` decides by the first file: ``.npy`` of floats are features; 8-bit colours
                are colours, one channel of whole numbers labels; images of one channel with 16 bits
                or floats are depth.

        Raises:
            DataError: A file cannot be read, is not square, differs from the others, or cannot be
                of this kind.
        """
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            arrays = list(pool.map(partial(read_pixels, indices=kind != "color"), files))
        first = arrays[0]
        if first.shape[0] != first.shape[1]:
            raise DataError(
                files[0], found=f"{first.shape[0]}×{first.shape[1]} pixels", expected="a square"
            )
        _check_alike(files, arrays)
        decided = _kind_of(files[0], first) if kind == "auto" else kind
        if decided is None or not _possible(decided, first):
            raise DataError(
                files[0],
                found=_described(first),
                expected=f"{kind} images" if kind != "auto" else "pixels that say what they are",
                remedy=f"Say what they are with kind={', '.join(KINDS)}: labels and depth have one "
                "channel, colours one or three.",
            )
        return cls(arrays, grid, decided)

    @property
    def suffix(self) -> str:
        """The suffix of a file that can hold the panorama as it is."""
        if self.kind == "features":
            return ".npy"
        return ".tif" if self._dtype(".tif").kind == "f" else ".png"

    def _dtype(self, suffix: str) -> np.dtype[Any]:
        """Type of numbers of the panorama in a file: what images hold, where nothing is lost."""
        dtype = self.arrays[0].dtype
        if suffix == ".npy":
            return dtype
        if self.kind == "labels":
            values = [int(value) for array in self.arrays for value in (array.min(), array.max())]
            return np.result_type(*map(np.min_scalar_type, (min(values), max(values))))
        return np.dtype(np.float32) if dtype.kind == "f" else dtype

    def write(self, path: Path, shape: tuple[int, int], blend: Blend, *, z_depth: bool) -> None:
        """Render them back to a panorama.

        Results of another size than the images are taken to show the same, edge to edge.

        Args:
            path: The panorama's file. Arrays (``.npy``) keep the type of numbers; in images, floats
                are 32-bit and labels the smallest unsigned numbers that hold them.
            shape: ``(H, W)`` of the panorama.
            blend: How overlapping images are joined, of colours and features.
            z_depth: Whether depth is along the axes of the images' cameras, to be turned into
                distance from the centre.

        Raises:
            SettingError: Such a file cannot hold it, or `z_depth` is set for no depth.
            DataError: Distances do not fit into the type of numbers.
        """
        if z_depth and self.kind != "depth":
            raise SettingError("z_depth", found=f"true for {self.kind}", expected="depth")
        suffix = path.suffix.lower()
        if suffix in LOSSY_SUFFIXES and self.kind != "color":
            raise SettingError(
                "output",
                found=path.name,
                expected=f"png, tif or npy: {suffix} would change the {self.kind}",
            )
        channels = self.arrays[0].shape[2:]
        check_writable(suffix, self._dtype(suffix), channels[0] if channels else 1)
        size = self.arrays[0].shape[0]
        grid = self.grid if size == self.grid.dim else ResizedGrid(self.grid, size)
        arrays = (
            [_distances(array, grid, path) for array in self.arrays] if z_depth else self.arrays
        )
        if suffix != ".npy":
            panorama = np.empty((*shape, *channels), arrays[0].dtype)
            self._render(arrays, grid, blend, panorama)
            write_pixels(path, panorama.astype(self._dtype(suffix), copy=False))
            return
        with atomic_path(path) as temporary:
            mapped = open_memmap(temporary, "w+", arrays[0].dtype, (*shape, *channels))
            with temporary.open("r+b") as file:
                reserve(file, temporary.stat().st_size)
            self._render(arrays, grid, blend, mapped)
            mapped.flush()

    def _render(
        self, arrays: Sequence[NDArray[Any]], grid: PinholeGrid, blend: Blend, out: NDArray[Any]
    ) -> None:
        shape = (out.shape[0], out.shape[1])
        if self.kind in ("labels", "depth"):
            out[:] = tangent_to_equirect(np.stack(arrays), grid, shape, interpolation="nearest")
        elif out.ndim == 2:
            out[:] = tangent_to_equirect(np.stack(arrays), grid, shape, blend)
        else:
            step = max(1, _GROUP_BYTES // (4 * grid.num_images * grid.dim**2))
            for start in range(0, out.shape[2], step):
                group = np.stack([array[..., start : start + step] for array in arrays])
                out[..., start : start + step] = tangent_to_equirect(group, grid, shape, blend)


def _check_alike(files: Sequence[Path], arrays: Sequence[NDArray[Any]]) -> None:
    first = arrays[0]
    for file, array in zip(files, arrays, strict=True):
        if array.shape != first.shape or array.dtype != first.dtype:
            raise DataError(
                file,
                found=_described(array),
                expected=f"{_described(first)}, as {files[0].name}",
                remedy="All results of a panorama have to be alike.",
            )


def _described(array: NDArray[Any]) -> str:
    return f"{'×'.join(map(str, array.shape))} of {array.dtype}"


def _kind_of(file: Path, array: NDArray[Any]) -> Kind | None:
    is_array, kind = file.suffix.lower() == ".npy", array.dtype.kind
    if is_array and kind == "f":
        return "features"
    if array.ndim == 3:
        return "color" if array.shape[2] == 3 and kind != "b" else None
    if kind == "f" or (array.dtype == np.uint16 and not is_array):
        return "depth"
    return "labels"


def _possible(kind: Kind, array: NDArray[Any]) -> bool:
    types = {"labels": "bui", "depth": "uif", "color": "uif", "features": "uif"}[kind]
    channels = {"labels": ((),), "depth": ((),), "color": ((), (3,))}.get(kind)
    return array.dtype.kind in types and (channels is None or array.shape[2:] in channels)


def _distances(depth: NDArray[Any], grid: PinholeGrid, path: Path) -> NDArray[Any]:
    """Distances from the centre, of depth ``(d, d)`` along the axis of an image's camera."""
    line = (np.arange(grid.dim) - (grid.dim - 1) / 2) * grid.pitch
    lengths = np.sqrt(1 + line[:, None] ** 2 + line**2)
    if depth.dtype.kind == "f":
        return (depth * lengths).astype(depth.dtype)
    missing = (depth == _NO_DEPTH) & (depth.dtype == np.uint16)
    distances = np.where(missing, depth, np.rint(depth * lengths))
    if distances.max() > np.iinfo(depth.dtype).max:
        raise DataError(
            path,
            found=f"distances up to {distances.max():.0f}",
            expected=f"at most {np.iinfo(depth.dtype).max}, which {depth.dtype} holds",
            remedy="Save the depth as floats (.tif or .npy).",
        )
    return distances.astype(depth.dtype)
