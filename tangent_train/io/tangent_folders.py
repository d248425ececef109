"""Folders of tangent images: writing them, and rendering results of other programs on them back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tangent_train import rendering
from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry import PinholeGrid, ray_lengths
from tangent_train.io import pixel_files
from tangent_train.io.camera_files import CameraFile, View
from tangent_train.io.gpano import Eye, PanoramaArea, eye_part, read_area, read_tags
from tangent_train.io.videos import Frame
from tangent_train.rendering import Blend, Interpolation, equirect_to_tangent
from tangent_train.rendering.resampling import reduce_to_pitch
from tangent_train.threads import in_threads

ResultKind = Literal["color", "labels", "depth", "features"]
"""Meaning of pixels: colors and features are interpolated, labels and depth are not."""

_TYPES = {"color": "uif", "labels": "bui", "depth": "uif", "features": "uif"}
_CHANNELS = {"color": ((), (3,)), "labels": ((),), "depth": ((),)}

_NO_DEPTH = 65535
"""Value for missing depth in many 16-bit files, besides 0."""


def read_placed(
    path: Path,
    interpolation: Interpolation,
    angles: Sequence[float] | None = None,
    frame: Frame | None = None,
    channel: str | None = None,
    eye: Eye | None = None,
) -> tuple[NDArray[Any], PanoramaArea]:
    """Read a panorama of any dtype; place a part of a panorama on the whole sphere.

    Args:
        path: An image, an array or a video.
        interpolation: With ``nearest``, images with a palette give its indices.
        angles: See `read_area`.
        frame: Frame of a video, of one eye.
        channel: Channel of OpenEXR images, see `read_pixels`.
        eye: Eye of a stereo image, see `eye_part`.

    Returns:
        ``(H, W)`` or ``(H, W, C)`` of the whole sphere, 0 outside of the part; and the part.

    Raises:
        DataError: The file cannot be used.
        SettingError: The angles are invalid.
    """
    is_nearest = interpolation == "nearest"
    if frame:
        image, tags = frame(), frame.tags
    else:
        options: Any = {"indices": is_nearest, "in_srgb": not is_nearest, "channel": channel}
        image, tags = pixel_files.read_pixels(path, **options), read_tags(path)
        image = image[eye_part(path, (image.shape[0], image.shape[1]), eye, angles, tags)]
    area = read_area(path, (image.shape[0], image.shape[1]), angles, tags=tags)
    return area.place(image), area


def face_name(face: int, count: int) -> str:
    """Return the name of one of some images, e.g. ``face_007``; names sort like the images."""
    return f"face_{face:0{max(3, len(str(count - 1)))}}"


def flat_name(name: str) -> str:
    """Return the name of a panorama without folders, for COLMAP.

    >>> flat_name("x/1")
    'x__1'
    """
    return name.replace("/", "__")


def write_views(
    image: NDArray[Any],
    files: Mapping[Path, View],
    interpolation: Interpolation,
    progress: Callable[[float], object],
) -> None:
    """Render tangent images to files in threads; existing files are replaced.

    Args:
        image: ``(H, W)`` or ``(H, W, C)`` panorama.
        files: Image of each file.
        interpolation: See `equirect_to_tangent`.
        progress: Called with the share of the images written since its last call.

    Raises:
        SettingError: The panorama cannot be rendered, or the files cannot hold its pixels.
    """
    reduced: dict[float, NDArray[Any]] = {}
    if interpolation == "bilinear":
        pitches = {min(grid.pitches) for grid, _ in files.values()}
        reduced = {pitch: reduce_to_pitch(image, pitch) for pitch in pitches}

    def write(item: tuple[Path, View]) -> None:
        path, (grid, face) = item
        source = reduced.get(min(grid.pitches), image)
        (pixels,) = equirect_to_tangent(source, grid, [face], interpolation)
        pixel_files.write_pixels(path, pixels)

    with closing(in_threads(write, files.items())) as written:
        for _ in written:
            progress(1 / len(files))


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
    there: dict[str, list[Path]] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() in pixel_files.READABLE_SUFFIXES:
            there.setdefault(file.stem, []).append(file)
    names = dict(zip(cameras.faces, cameras.files, strict=True))
    stems = [Path(names.get(f, f"file of image {f}")).stem for f in cameras.grid.face_indices()]
    wrong = [stem for stem in stems if len(there.get(stem, [])) != 1]
    if wrong:
        files = " and ".join(file.name for file in there.get(wrong[0], []))
        raise DataError(
            folder,
            found=files or f"no {wrong[0]}",
            expected=f"one file for each of the {len(stems)} images of the sphere, named as in the "
            "cameras",
            remedy="Render the panorama without faces=…, put results into a separate folder, and "
            "give cameras=<folder of the images>.",
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
        cls,
        files: Sequence[Path],
        grid: PinholeGrid,
        kind: ResultKind | Literal["auto"],
        channel: str | None = None,
    ) -> TangentResults:
        """Read and check result files.

        Args:
            files: One file for each image, in the order of the grid, see `result_files`.
            grid: Grid of the images.
            kind: ``auto`` decides by the first file: ``.npy`` of floats are features; three
                channels are colors, one channel of integers labels; images of one channel with 16
                bits or floats are depth.
            channel: Channel of OpenEXR images, see `read_pixels`.

        Raises:
            DataError: A file cannot be read, differs from the others, cannot be of this kind, or
                has another ratio of sides than the images.
        """
        read = partial(pixel_files.read_pixels, indices=kind != "color", channel=channel)
        arrays = list(in_threads(read, files))
        first = arrays[0]
        decided = _kind_of(files[0], first) if kind == "auto" else kind
        channels = _CHANNELS.get(decided, (first.shape[2:],))
        is_usable = first.dtype.kind in _TYPES[decided] and first.shape[2:] in channels
        is_usable &= first.shape[0] * grid.size[1] == first.shape[1] * grid.size[0]
        for file, array in zip(files, arrays, strict=True):
            if not is_usable or (array.shape, array.dtype) != (first.shape, first.dtype):
                raise DataError(
                    file,
                    found=f"{array.dtype} of shape {array.shape}",
                    expected=f"{decided} of one type and shape in all files, in the ratio of "
                    f"{width_height(grid.size)}; labels and depth have one channel, colors one or "
                    "three",
                    remedy=f"Choose kind={', '.join(get_args(ResultKind))}.",
                )
        size = first.shape[0], first.shape[1]
        return cls(arrays, grid if size == grid.size else grid.resized(size), decided)

    @property
    def suffix(self) -> str:
        """Suffix of a file format that keeps the pixels unchanged."""
        if self.kind == "features":
            return ".npy"
        return ".tif" if self.arrays[0].dtype.kind == "f" else ".png"

    def write(self, path: Path, shape: tuple[int, int], blend: Blend, *, z_depth: bool) -> int:
        """Render the results back to a panorama, and write it.

        Results of another size than the images cover the same field of view, edge to edge.

        Args:
            path: File of the panorama. Arrays (``.npy``) keep the dtype; images hold 32-bit floats,
                or labels in the smallest integers that suffice.
            shape: ``(H, W)`` of the panorama.
            blend: Blending of overlapping images, for colors and features.
            z_depth: True to convert z-depth of the images to distance from the center. In integers
                that cannot hold a distance, it is missing: 0.

        Returns:
            Number of pixels of the images whose distance the integers cannot hold.

        Raises:
            SettingError: The format cannot hold the pixels, or `z_depth` is set without depth.
        """
        suffix = path.suffix.lower()
        is_lossy = suffix in pixel_files.LOSSY_SUFFIXES and self.kind != "color"
        if is_lossy or (z_depth and self.kind != "depth"):
            setting = "output" if is_lossy else "z_depth"
            expected = "depth with z_depth=true, and png, tif or npy for all but colors"
            raise SettingError(setting, found=f"{self.kind} to {path.name}", expected=expected)
        dtype = self._image_dtype() if suffix != ".npy" else self.arrays[0].dtype
        arrays = [_distances(array, self.grid) for array in self.arrays] if z_depth else self.arrays
        interpolation: Interpolation = "bilinear"
        if self.kind in ("labels", "depth"):
            interpolation, blend = "nearest", "nearest"
        panorama: NDArray[Any] = rendering.tangent_to_equirect(
            np.stack(arrays), self.grid, shape, blend, interpolation
        )
        pixel_files.write_pixels(path, panorama.astype(dtype, copy=False))
        pairs = zip(self.arrays, arrays, strict=True) if z_depth else ()
        return sum(int(((after == 0) & (before % _NO_DEPTH != 0)).sum()) for before, after in pairs)

    def _image_dtype(self) -> np.dtype[Any]:
        dtype = self.arrays[0].dtype
        if self.kind == "labels":
            values = [int(value) for array in self.arrays for value in (array.min(), array.max())]
            return np.result_type(*map(np.min_scalar_type, (min(values), max(values))))
        return np.dtype(np.float32) if dtype.kind == "f" else dtype


def _kind_of(file: Path, array: NDArray[Any]) -> ResultKind:
    is_array, kind = file.suffix.lower() == ".npy", array.dtype.kind
    if is_array and kind == "f":
        return "features"
    if array.ndim == 3:
        return "color"
    return "depth" if kind == "f" or (array.dtype == np.uint16 and not is_array) else "labels"


def _distances(depth: NDArray[Any], grid: PinholeGrid) -> NDArray[Any]:
    """Convert z-depth ``(h, w)`` of an image to distances."""
    distances = depth * ray_lengths(grid.camera_matrix, depth.shape)
    if depth.dtype.kind != "f":
        missing = (depth == _NO_DEPTH) & (depth.dtype == np.uint16)
        distances = np.where(missing, depth, np.rint(distances))
        distances[distances > np.iinfo(depth.dtype).max] = 0
    return distances.astype(depth.dtype)
