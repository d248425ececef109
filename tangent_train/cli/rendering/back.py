"""``tangent-render back=…``: results for tangent images to panoramas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.images.pixel_files import PIXEL_SUFFIXES
from datamodules.images.tangent_results import TangentResults, result_files
from tangent_train.cli.rendering.reports import Failures, refuse_existing, say
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering.camera_files import CAMERAS_FILE, read_cameras

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from tangent_train.cli.rendering.settings import BackSettings

__all__ = ["render_back"]


@dataclass(frozen=True)
class _Task:
    """Results for one panorama.

    Attributes:
        folder: Where they are.
        cameras: Their ``cameras.json``.
        output: The panorama's file.
        named: Whether its suffix is given; else it is added as the results need.
    """

    folder: Path
    cameras: Path
    output: Path
    named: bool


def render_back(settings: BackSettings) -> None:
    """Render all results; some that cannot be used do not stop the others.

    Raises:
        DataError: There are none, or some could not be rendered.
        SettingError: Earlier results would be overwritten, or the output's name says no format.
    """
    tasks = _find(settings)
    if not settings.overwrite:
        refuse_existing([path for task in tasks for path in _possible_files(task)])
    failures = Failures("panorama", len(tasks))
    if len(tasks) == 1:
        with failures.kept(tasks[0].folder):
            say(f"Panorama: {_render(tasks[0], settings)}")
    else:
        from datamodules.core.progress import show_progress

        show_progress(_render_all(tasks, settings, failures), "Panoramas", "panoramas", len(tasks))
        say(f"{len(tasks) - len(failures)} panoramas: {settings.output}")
    failures.report()


def _render_all(
    tasks: Sequence[_Task], settings: BackSettings, failures: Failures
) -> Iterator[Path | None]:
    for task in tasks:
        written = None
        with failures.kept(task.folder):
            written = _render(task, settings)
        yield written


def _find(settings: BackSettings) -> list[_Task]:
    """One task where the cameras are given or beside the results, else one for every folder."""
    back, given = settings.back, settings.cameras
    if not back.is_dir():
        raise DataError(back, found="no such folder", expected="a folder of results")
    if given is not None and not given.is_dir():
        return [_single(settings, given)]
    # Results may lie apart from the tangent images, in folders of the same names.
    root = back if given is None else given
    if (root / CAMERAS_FILE).is_file():
        return [_single(settings, root / CAMERAS_FILE)]
    folders = sorted(path.parent.relative_to(root) for path in root.rglob(CAMERAS_FILE))
    folders = [folder for folder in folders if (back / folder).is_dir()]
    if not folders:
        raise DataError(
            root,
            found=f"no {CAMERAS_FILE}",
            expected="the cameras of the tangent images",
            remedy="Give cameras=<the folder that tangent-render wrote>.",
        )
    if settings.output.suffix.lower() in PIXEL_SUFFIXES:
        raise SettingError(
            "output",
            found=str(settings.output),
            expected=f"a folder for the {len(folders)} panoramas whose results are in {back}",
        )
    return [
        _Task(back / folder, root / folder / CAMERAS_FILE, settings.output / folder, named=False)
        for folder in folders
    ]


def _single(settings: BackSettings, cameras: Path) -> _Task:
    if settings.output.suffix.lower() not in PIXEL_SUFFIXES:
        raise SettingError(
            "output",
            found=str(settings.output),
            expected=f"the name of a file that ends in {' or '.join(PIXEL_SUFFIXES)}",
        )
    return _Task(settings.back, cameras, settings.output, named=True)


def _possible_files(task: _Task) -> list[Path]:
    if task.named:
        return [task.output]
    return [task.output.with_name(task.output.name + suffix) for suffix in PIXEL_SUFFIXES]


def _render(task: _Task, settings: BackSettings) -> Path:
    cameras = read_cameras(task.cameras)
    files = result_files(task.folder, cameras)
    results = TangentResults.read(files, cameras.grid, settings.kind)
    output = task.output
    if not task.named:
        output = output.with_name(output.name + results.suffix)
    height = settings.height
    shape = cameras.shape if height is None else (height, 2 * height)
    results.write(output, shape, settings.blend, z_depth=settings.z_depth)
    return output
