"""``tangent-render``: tangent images as files for other programs, and back."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console

from datamodules.images.image_files import image_paths, short_names
from datamodules.images.pixel_files import LOSSY_SUFFIXES, PIXEL_SUFFIXES, write_pixels
from datamodules.images.tangent_folders import (
    read_panorama,
    shrink_to_level,
    write_tangent_folder,
)
from datamodules.images.tangent_results import Kind, TangentResults, result_files
from tangent_train.cli.each import each
from tangent_train.cli.settings import typed
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import TangentGrid, nearest_level, random_rotation, rotation_about
from tangent_train.rendering.camera_files import CAMERAS_FILE, CameraFile, read_cameras
from tangent_train.rendering.figure import tangent_figure

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    _Work = Callable[[Path, Path, Callable[[float], object]], Path]

__all__ = ["render"]


@dataclass(frozen=True)
class Settings:
    """See ``configs/render.yaml``."""

    input: str | None
    output: Path | None
    overwrite: bool
    base_level: int
    level: int | None
    dim: int | None
    faces: tuple[int, ...] | None
    rotation: Literal["so3"] | tuple[float, float, float] | None
    seed: int
    format: str
    interpolation: Literal["bilinear", "nearest"]
    colmap: bool
    figure: Path | None
    back: Path | None
    cameras: Path | None
    blend: Literal["feather", "nearest"]
    height: int | None
    kind: Literal["auto"] | Kind
    z_depth: bool


def render(config: Mapping[str, Any]) -> None:
    """Render panoramas to tangent images, or results for tangent images to panoramas.

    Args:
        config: The composed ``render.yaml``.

    Raises:
        DataError: There is nothing to render.
        SettingError: A setting is invalid, or a file would be overwritten.
    """
    settings = typed(Settings, config)
    if (settings.input is None) == (settings.back is None):
        raise SettingError(
            "input and back",
            found="none of them" if settings.input is None else "both",
            expected="input=<panoramas>, or back=<results for tangent images>",
        )
    if settings.output is None and (settings.back or not settings.figure):
        raise SettingError("output", found="none", expected="a folder, or with back= a file")
    work, jobs = _forward(settings) if settings.input is not None else _back(settings)
    done = [result for _, result, _ in each("Rendering", jobs, work) if result is not None]
    if done:
        listed = f"{done[0]}" + (f" and {len(done) - 1} more" if done[1:] else "")
        Console(highlight=False).print(f"Written: {listed}", soft_wrap=True, markup=False)
    if len(done) < len(jobs):
        failed = f"{len(jobs) - len(done)} of {len(jobs)} panoramas"
        sys.exit(f"tangent-render: {failed} could not be rendered, see above")


def _forward(settings: Settings) -> tuple[_Work, dict[Path, Path]]:
    """Function that renders a panorama to a folder, and the panorama of every folder."""
    found = image_paths(settings.input or "")
    paths = [path for path in found if not (path.parent / CAMERAS_FILE).exists()]
    if not paths:
        raise DataError(settings.input, found="only tangent images", expected="panoramas")
    if settings.figure is not None and len(paths) > 1:
        raise SettingError("figure", found=f"{len(paths)} panoramas", expected="one")
    suffix = f".{settings.format}"
    if settings.interpolation == "nearest" and suffix in LOSSY_SUFFIXES:
        expected = "png, tif or npy with interpolation=nearest: others change pixels"
        raise SettingError("format", found=settings.format, expected=expected)
    rotation = _rotation(settings)
    output = Path() if settings.output is None else settings.output
    jobs = {output / name: path for name, path in zip(short_names(paths), paths, strict=True)}
    _refuse_existing(settings, [*(jobs if settings.output else ()), settings.figure])

    def work(folder: Path, path: Path, progress: Callable[[float], object]) -> Path:
        image = read_panorama(path, settings.interpolation)
        shape = image.shape[0], image.shape[1]
        level = nearest_level(shape[0]) if settings.level is None else settings.level
        grid = TangentGrid(settings.base_level, level, settings.dim, rotation)
        faces = tuple(int(face) for face in grid.face_indices(settings.faces))
        if settings.figure is not None:
            write_pixels(settings.figure, tangent_figure(image, grid))
            if settings.output is None:
                return settings.figure
        digits = max(3, len(str(grid.num_images - 1)))
        files = tuple(f"face_{face:0{digits}}{suffix}" for face in faces)
        if settings.interpolation == "bilinear":
            image = shrink_to_level(image, level)
        cameras = CameraFile(path.name, shape, grid, faces, files)
        write_tangent_folder(
            folder, image, cameras, settings.interpolation, progress, colmap=settings.colmap
        )
        return folder

    return work, jobs


def _rotation(settings: Settings) -> NDArray[np.float64] | None:
    """In the frame of directions: x forward, y to the right, z up."""
    if settings.rotation is None:
        return None
    if settings.rotation == "so3":
        return random_rotation(np.random.default_rng(settings.seed))
    yaw, pitch, roll = np.radians(settings.rotation)
    # y is to the right here: a positive rotation about it looks down.
    return (
        rotation_about((0, 0, 1), yaw)
        @ rotation_about((0, 1, 0), -pitch)
        @ rotation_about((1, 0, 0), -roll)
    )


def _back(settings: Settings) -> tuple[_Work, dict[Path, Path]]:
    """Function that renders the results in a folder, and the folder of every panorama."""
    back, output = settings.back or Path(), settings.output or Path()
    if not back.is_dir():
        raise DataError(back, found="no such folder", expected="a folder of results")
    root = settings.cameras or back
    of_one = root if root.is_file() else root / CAMERAS_FILE
    found = sorted(path.parent.relative_to(root) for path in root.rglob(CAMERAS_FILE))
    cameras = {output / name: root / name / CAMERAS_FILE for name in found}
    jobs = {output / name: back / name for name in found if (back / name).is_dir()}
    if of_one.is_file():
        if output.suffix.lower() not in PIXEL_SUFFIXES:
            raise SettingError(
                "output", found=output, expected=f"a name ending in {', '.join(PIXEL_SUFFIXES)}"
            )
        _refuse_existing(settings, [output])
        cameras, jobs = {output: of_one}, {output: back}
    if not jobs:
        raise DataError(
            root,
            found=f"no {CAMERAS_FILE}",
            expected="the cameras of the tangent images",
            remedy="Give cameras=<the folder that tangent-render wrote>.",
        )

    def work(path: Path, folder: Path, _: Callable[[float], object]) -> Path:
        of = read_cameras(cameras[path])
        results = TangentResults.read(result_files(folder, of), of.grid, settings.kind)
        if not of_one.is_file():
            path = path.with_name(path.name + results.suffix)
            _refuse_existing(settings, [path])
        rows = settings.height
        shape = of.shape if rows is None else (rows, 2 * rows)
        results.write(path, shape, settings.blend, z_depth=settings.z_depth)
        return path

    return work, jobs


def _refuse_existing(settings: Settings, paths: list[Path | None]) -> None:
    if settings.overwrite:
        return
    for path in filter(None, paths):
        if any(path.iterdir()) if path.is_dir() else path.exists():
            raise SettingError(
                "output",
                found=f"{path}, which exists",
                expected="nothing there yet",
                remedy="Choose another output, or overwrite=true.",
            )
