"""Rendering results of other programs on tangent images back to the panorama."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry import PinholeGrid, ray_lengths
from tangent_train.io import pixel_files
from tangent_train.io.camera_files import CameraFile
from tangent_train.rendering import Blend, tangent_to_equirect
from tangent_train.threads import in_threads

ResultKind = Literal["color", "labels", "depth", "features"]
"""Meaning of pixels: colors and features are interpolated, labels and depth are not."""

_TYPES = {"color": "uif", "labels": "bui", "depth": "uif", "features": "uif"}
_CHANNELS = {"color": ((), (3,)), "labels": ((),), "depth": ((),)}

_GROUP_BYTES = 2**28
"""Largest size in bytes of the images of channels that are rendered together."""

_NO_DEPTH = 65535
"""Value for missing depth in many 16-bit files, besides 0."""


def result_files(folder: Path, cameras: CameraFile) -> list[Path]:
    """List the result files for all images of a grid, which have the names of the images.

    Args:
        folder: Folder of the results.
        cameras: Cameras of the images.

    Returns:
        One file for each image of the grid, in the order of the grid.

    Raises:
        DataError: A file is missing, or two files have the same name.
    """
    grid = cameras.grid
    if len(cameras.faces) < grid.num_images:
        raise DataError(
            folder,
            found=f"cameras of {len(cameras.faces)} of the {grid.num_images} images",
            expected="all of them, to cover the whole sphere",
            remedy="Render the panorama without faces=….",
        )
    there: dict[str, list[Path]] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() in pixel_files.READABLE_SUFFIXES:
            there.setdefault(file.stem, []).append(file)
    stems = [Path(name).stem for _, name in sorted(zip(cameras.faces, cameras.files, strict=True))]
    wrong = [stem for stem in stems if len(there.get(stem, [])) != 1]
    if wrong:
        files = " and ".join(file.name for file in there.get(wrong[0], []))
        raise DataError(
            folder,
            found=files or f"no {wrong[0]}",
            expected=f"one file for each of the {len(stems)} images of the cameras, named as these",
            remedy="Put results into a separate folder, and give cameras=<folder of the images>.",
        )
    return [there[stem][0] for stem in stems]


@dataclass(frozen=True)
class TangentResults:
    """Results for all images of one panorama.

    Attributes:
        arrays: ``(h, w)`` or ``(h, w, C)`` for every image of the grid, all of one shape and dtype.
        grid: Grid of the images, with the size of the results.
        kind: Meaning of the pixels.
    """

    arrays: Sequence[NDArray[Any]]
    grid: PinholeGrid
    kind: ResultKind

    @classmethod
    def read(
        cls, files: Sequence[Path], grid: PinholeGrid, kind: ResultKind | Literal["auto"]
    ) -> TangentResults:
        """Read and check result files.

        Args:
            files: One file for each image, in the order of the grid, see `result_files`.
            grid: Grid of the images.
            kind: ``auto`` decides by the first file: ``.npy`` of floats are features; three
                channels are colors, one channel of integers labels; images of one channel with 16
                bits or floats are depth.

        Raises:
            DataError: A file cannot be read, differs from the others, cannot be of this kind, or
                has another ratio of sides than the images.
        """
        arrays = list(in_threads(partial(pixel_files.read_pixels, indices=kind != "color"), files))
        first = arrays[0]
        size = first.shape[0], first.shape[1]
        if size[0] * grid.size[1] != size[1] * grid.size[0]:
            expected = f"images in the ratio of {width_height(grid.size)}"
            raise DataError(files[0], found=width_height(size), expected=expected)
        grid = grid if size == grid.size else grid.resized(size)
        for file, array in zip(files, arrays, strict=True):
            if (array.shape, array.dtype) != (first.shape, first.dtype):
                raise DataError(
                    file,
                    found=f"{array.dtype} of shape {array.shape}",
                    expected=f"that of the first file: {first.dtype} of shape {first.shape}",
                )
        decided = _kind_of(files[0], first) if kind == "auto" else kind
        channels = _CHANNELS.get(decided, (first.shape[2:],))
        if first.dtype.kind not in _TYPES[decided] or first.shape[2:] not in channels:
            raise DataError(
                files[0],
                found=f"{first.dtype} of shape {first.shape}",
                expected=f"{decided}",
                remedy=f"Choose kind={', '.join(get_args(ResultKind))}: labels and depth have one "
                "channel, colors one or three.",
            )
        return cls(arrays, grid, decided)

    @property
    def suffix(self) -> str:
        """Suffix of a file format that keeps the pixels unchanged."""
        if self.kind == "features":
            return ".npy"
        return ".tif" if self.arrays[0].dtype.kind == "f" else ".png"

    def write(self, path: Path, shape: tuple[int, int], blend: Blend, *, z_depth: bool) -> None:
        """Render the results back to a panorama, and write it.

        Results of another size than the images cover the same field of view, edge to edge.

        Args:
            path: File of the panorama. Arrays (``.npy``) keep the dtype; images hold 32-bit floats,
                or labels in the smallest integers that suffice.
            shape: ``(H, W)`` of the panorama.
            blend: Blending of overlapping images, for colors and features.
            z_depth: True to convert z-depth of the images to distance from the center.

        Raises:
            SettingError: The format cannot hold the pixels, or `z_depth` is set without depth.
            DataError: Distances do not fit into the dtype.
        """
        suffix, channels = path.suffix.lower(), self.arrays[0].shape[2:]
        if z_depth and self.kind != "depth":
            raise SettingError("z_depth", found=f"true for {self.kind}", expected="depth")
        if suffix in pixel_files.LOSSY_SUFFIXES and self.kind != "color":
            expected = f"png, tif or npy: {suffix} would change the {self.kind}"
            raise SettingError("output", found=path.name, expected=expected)
        dtype = self._image_dtype() if suffix != ".npy" else self.arrays[0].dtype
        pixel_files.check_writable(suffix, dtype, channels[0] if channels else 1)
        arrays = self.arrays
        if z_depth:
            arrays = [_distances(array, self.grid, path) for array in arrays]
        whole = (*shape, *channels)
        if suffix == ".npy":
            with pixel_files.array_file(path, whole, dtype) as out:
                self._render(arrays, blend, out)
        else:
            panorama = np.empty(whole, arrays[0].dtype)
            self._render(arrays, blend, panorama)
            pixel_files.write_pixels(path, panorama.astype(dtype, copy=False))

    def _image_dtype(self) -> np.dtype[Any]:
        dtype = self.arrays[0].dtype
        if self.kind == "labels":
            values = [int(value) for array in self.arrays for value in (array.min(), array.max())]
            return np.result_type(*map(np.min_scalar_type, (min(values), max(values))))
        return np.dtype(np.float32) if dtype.kind == "f" else dtype

    def _render(self, arrays: Sequence[NDArray[Any]], blend: Blend, out: NDArray[Any]) -> None:
        grid = self.grid
        shape = (out.shape[0], out.shape[1])
        if self.kind in ("labels", "depth"):
            out[:] = tangent_to_equirect(np.stack(arrays), grid, shape, interpolation="nearest")
            return
        channels = out.shape[2:]
        step = max(1, _GROUP_BYTES // (4 * grid.num_images * math.prod(grid.size)))
        for start in range(0, channels[0], step) if channels else (0,):
            part = (..., slice(start, start + step)) if channels else ...
            group = np.stack([array[part] for array in arrays])
            out[part] = tangent_to_equirect(group, grid, shape, blend)


def _kind_of(file: Path, array: NDArray[Any]) -> ResultKind:
    is_array, kind = file.suffix.lower() == ".npy", array.dtype.kind
    if is_array and kind == "f":
        return "features"
    if array.ndim == 3:
        return "color"
    return "depth" if kind == "f" or (array.dtype == np.uint16 and not is_array) else "labels"


def _distances(depth: NDArray[Any], grid: PinholeGrid, path: Path) -> NDArray[Any]:
    """Convert z-depth ``(h, w)`` of an image to distances."""
    lengths = ray_lengths(grid.camera_matrix, depth.shape)
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
