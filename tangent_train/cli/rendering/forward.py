"""``tangent-render input=…``: panoramas to folders of tangent images."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datamodules.images.image_files import find_images
from datamodules.images.tangent_folders import TangentFolder, read_panorama, shrink_to_level
from tangent_train.cli.rendering.reports import Failures, refuse_existing, say
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_bytes
from tangent_train.geometry import TangentGrid
from tangent_train.geometry.levels import nearest_level
from tangent_train.rendering.camera_files import CAMERAS_FILE, CameraFile

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from tangent_train.cli.rendering.settings import ForwardSettings

__all__ = ["render_forward"]


def render_forward(settings: ForwardSettings) -> None:
    """Render all panoramas; one that cannot be rendered does not stop the others.

    Raises:
        DataError: There are none, or some could not be rendered.
        SettingError: Settings do not fit together, or earlier results would be overwritten.
    """
    paths, root = _find(settings)
    folders = {} if settings.output is None else _folders(paths, root, settings.output)
    if settings.figure is not None and len(paths) > 1:
        raise SettingError(
            "figure", found=f"{len(paths)} panoramas", expected="one: a figure is of one"
        )
    figures = [] if settings.figure is None else [settings.figure]
    if not settings.overwrite:
        refuse_existing([*folders, *figures])
    if settings.level is not None:  # else it depends on the panorama
        _grid(settings, settings.level)
    failures = Failures("panorama", len(paths))
    if folders:
        _write_folders(folders, settings, failures)
    if settings.figure is not None and not failures:
        with failures.kept(paths[0]):
            _write_figure(paths[0], settings.figure, settings)
    failures.report()


def _find(settings: ForwardSettings) -> tuple[list[Path], Path]:
    """The panoramas, and the folder they all are in."""
    paths = find_images(settings.input)
    searched = Path(settings.input).expanduser()
    if searched.is_dir():
        # Tangent images of an earlier run are no panoramas.
        paths = [path for path in paths if not (path.parent / CAMERAS_FILE).exists()]
        root = searched
    else:
        root = Path(os.path.commonpath([path.parent for path in paths]))
    if not paths:
        raise DataError(settings.input, found="only tangent images", expected="panoramas")
    return paths, root


def _folders(paths: Sequence[Path], root: Path, output: Path) -> dict[Path, Path]:
    """The panorama of every folder; folders are arranged as the panoramas are."""
    folders: dict[Path, Path] = {}
    for path in paths:
        folder = output / path.relative_to(root).with_suffix("")
        if folder in folders:
            raise SettingError(
                "input",
                found=f"{folders[folder]} and {path}",
                expected="names that differ in more than their suffix",
                remedy="Their tangent images would get the same folder; render them one by one.",
            )
        folders[folder] = path
    return folders


def _write_folders(
    folders: Mapping[Path, Path], settings: ForwardSettings, failures: Failures
) -> None:
    from datamodules.core.progress import show_progress

    each = 20 * 4**settings.base_level if settings.faces is None else len(settings.faces)

    def written() -> Generator[str]:
        for folder, path in folders.items():
            with failures.kept(path):
                yield from _write_folder(path, folder, settings)

    with closing(written()) as files:
        show_progress(files, "Tangent images", "images", each * len(folders))
    done = len(folders) - len(failures)
    if done:
        say(f"{each * done} tangent images of {done} panorama{'s' * (done > 1)}: {settings.output}")


def _write_folder(path: Path, folder: Path, settings: ForwardSettings) -> Iterator[str]:
    image = read_panorama(path, settings.interpolation)
    grid = _grid(settings, _level(settings, image))
    faces = tuple(range(grid.num_images)) if settings.faces is None else settings.faces
    digits = max(3, len(str(grid.num_images - 1)))
    files = tuple(f"face_{face:0{digits}}{settings.suffix}" for face in faces)
    cameras = CameraFile(path.name, (image.shape[0], image.shape[1]), grid, faces, files)
    if settings.interpolation == "bilinear":
        image = shrink_to_level(image, grid.level)
    tangent_folder = TangentFolder(folder, cameras, settings.colmap)
    yield from tangent_folder.write(image, settings.interpolation)


def _write_figure(path: Path, figure: Path, settings: ForwardSettings) -> None:
    from tangent_train.rendering.figure import tangent_figure

    image = read_panorama(path, settings.interpolation)
    write_bytes(figure, tangent_figure(image, _grid(settings, _level(settings, image))))
    say(f"Figure: {figure}")


def _grid(settings: ForwardSettings, level: int) -> TangentGrid:
    return TangentGrid(settings.base_level, level, settings.dim, settings.rotation)


def _level(settings: ForwardSettings, image: NDArray[Any]) -> int:
    return nearest_level(image.shape[0]) if settings.level is None else settings.level
