"""``tangent-render``: write tangent images for other programs, and render their results back."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.folder.reader import class_masks
from tangent_train.cli.command_settings import RenderSettings
from tangent_train.cli.input_files import Inputs, is_video
from tangent_train.cli.jobs import Job, run_jobs
from tangent_train.cli.settings import check_new, check_unread, parse_settings
from tangent_train.config.build import build_from_config
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, counted
from tangent_train.geometry import PinholeGrid, TangentGrid, nearest_level, rotation_about
from tangent_train.inference.representations import view_settings
from tangent_train.io.camera_files import (
    CAMERAS_FILE,
    RIG_FILE,
    CameraFile,
    read_cameras,
    read_rig,
    write_poses,
)
from tangent_train.io.colmap_project import ColmapProject, flat_names
from tangent_train.io.masks import Masks
from tangent_train.io.pixel_files import (
    LOSSY_SUFFIXES,
    PIXEL_SUFFIXES,
    read_image_size,
    write_pixels,
)
from tangent_train.io.tangent_folders import (
    face_name,
    panorama_area,
    read_placed,
    replaced_folder,
    shrink_to_level,
    write_tangent_folder,
)
from tangent_train.io.tangent_results import TangentResults, result_files
from tangent_train.keypoints.colmap import panorama_poses
from tangent_train.rendering.figure import tangent_figure

_Work = Callable[[Job, Callable[[float], object]], Path]


def render(config: Mapping[str, Any]) -> None:
    """Render panoramas to tangent images, or results for tangent images to panoramas.

    Args:
        config: Composed ``render.yaml``.

    Raises:
        DataError: No files to render are found.
        SettingError: A setting is invalid, or a file would be overwritten.
    """
    settings = parse_settings(RenderSettings, config)
    modes = [name for name in ("input", "back", "poses") if getattr(settings, name) is not None]
    if len(modes) != 1:
        raise SettingError(
            "input, back and poses",
            found=" and ".join(modes) or "none of them",
            expected="input=<panoramas>, back=<results for tangent images>, or "
            "poses=<a model of COLMAP>",
        )
    if settings.output is None and (modes != ["input"] or not settings.figure):
        raise SettingError("output", found="null", expected="a folder, or with back= a file")
    colmap = settings.colmap and settings.input is not None
    if colmap:
        check_unread(settings, "with colmap=true", figure=None)
    else:
        check_unread(settings, "without colmap=true", mask=None, mask_classes=None)
    if settings.poses is not None:
        _write_panorama_poses(settings, settings.poses)
    elif colmap:
        _render_project(settings)
    else:
        jobs, count, work = (
            _rendering_jobs(settings) if settings.input is not None else _results_jobs(settings)
        )
        _print_written(_rendered(jobs, count, work), count)


def _rendered(jobs: Iterable[Job], count: int, work: _Work) -> list[Path]:
    """Render panoramas; return the results of those that could be rendered."""
    return [job.value for job in run_jobs("Rendering", jobs, count, work) if not job.error]


def _print_written(done: Sequence[Path], count: int) -> None:
    """Print the written files, and exit with status 1 if some panoramas were not rendered."""
    if done:
        first, *others = dict.fromkeys(done)
        print_text(f"Written: {first}" + (f" and {len(others)} more" if others else ""))
    if len(done) < count:
        failed = f"{count - len(done)} of {count} panoramas"
        sys.exit(f"tangent-render: {failed} could not be rendered, see above")


def _rendering_jobs(settings: RenderSettings) -> tuple[Iterable[Job], int, _Work]:
    """Return the panoramas, their number, and the function that renders one to its folder."""
    inputs, suffix = _panoramas(settings), _suffix(settings)
    _grid(settings, 512)  # invalid views are refused before any panorama
    names, output = inputs.names(), settings.output
    if settings.figure is not None and len(names) > 1:
        raise SettingError("figure", found=f"{len(names)} panoramas", expected="one panorama")
    folders = [] if output is None else [output / name for name in names]
    check_new(settings, *folders, settings.figure)

    def work(job: Job, progress: Callable[[float], object]) -> Path:
        image, _ = read_placed(job.path, settings.interpolation, settings.area, job.value)
        shape = image.shape[0], image.shape[1]
        grid, faces, level = _grid(settings, shape[0])
        if settings.figure is not None:
            if not isinstance(grid, TangentGrid):
                raise SettingError("figure", found="a file", expected=f"null, for {settings.views}")
            write_pixels(settings.figure, tangent_figure(image, grid))
            if output is None:
                return settings.figure
        files = tuple(f"{face_name(grid, face)}{suffix}" for face in faces)
        if settings.interpolation == "bilinear":
            image = shrink_to_level(image, level)
        cameras = CameraFile(job.path.name, shape, grid, faces, files)
        folder = (output or Path()) / job.item
        write_tangent_folder(folder, image, cameras, settings.interpolation, progress)
        return folder

    return inputs.missing(()), len(names), work


def _panoramas(settings: RenderSettings) -> Inputs:
    """Find the panoramas of `input`; tangent images that this command wrote are ignored."""

    def is_result(path: Path) -> bool:
        in_project = any((folder / RIG_FILE).exists() for folder in path.absolute().parents[2:3])
        return in_project or path.name == RIG_FILE or (path.parent / CAMERAS_FILE).exists()

    def check_size(path: Path, size: tuple[int, int]) -> None:
        panorama_area(path, size, settings.area)

    return Inputs.find(settings, is_result, check_size)


def _suffix(settings: RenderSettings) -> str:
    suffix = f".{settings.format}"
    if settings.interpolation == "nearest" and suffix in LOSSY_SUFFIXES:
        expected = "png, tif or npy with interpolation=nearest: other formats change pixels"
        raise SettingError("format", found=settings.format, expected=expected)
    return suffix


def _grid(settings: RenderSettings, rows: int) -> tuple[PinholeGrid, tuple[int, ...], int]:
    """Return the grid for a number of rows, the indices of the images to write, and the level."""
    level = nearest_level(rows) if settings.level is None else settings.level
    rotation = None
    if settings.rotation is not None:  # x forward, y to the right, z up
        yaw, pitch, roll = np.radians(settings.rotation)
        # A positive rotation about y looks down.
        tilt = rotation_about((0, 1, 0), -pitch) @ rotation_about((1, 0, 0), -roll)
        rotation = rotation_about((0, 0, 1), yaw) @ tilt
    section = view_settings(settings.views or {"option": "tangent", "base_level": 1})
    for name in ("base_level", "dim"):
        if (value := getattr(settings, name)) is not None:
            if name not in section:
                raise SettingError(name, found=value, expected=f"null, for {settings.views}")
            section[name] = value
    # Labels are rendered back from the owner of each direction.
    section |= {"level": level} | ({"blend": "nearest"} if "blend" in section else {})
    resting: PinholeGrid | None = getattr(build_from_config(section, "views"), "grid", None)
    if resting is None:
        raise SettingError("views", found=settings.views, expected="tangent, ring or cubemap")
    grid = resting.with_rotation(rotation)
    return grid, tuple(int(face) for face in grid.face_indices(settings.faces)), level


def _render_project(settings: RenderSettings) -> None:
    """Render all panoramas to one project for COLMAP."""
    inputs, suffix, output = _panoramas(settings), _suffix(settings), settings.output or Path()
    if suffix == ".npy":
        raise SettingError("format", found="npy", expected="png, jpg, webp or tif for COLMAP")
    check_new(settings, output)
    masks = _masks(settings)
    names = flat_names(inputs.names())
    # A camera has images of one size. Errors of unreadable panoramas are printed when rendering.
    grid, faces, level = _grid(settings, max(_rows(settings, inputs)) or 512)
    with replaced_folder(output) as folder:
        project = ColmapProject(folder, grid, level, faces, suffix, settings.interpolation)

        def work(job: Job, progress: Callable[[float], object]) -> Path:
            name, path = job.item, job.path
            image, area = read_placed(path, settings.interpolation, settings.area, job.value)
            file = name if is_video(path) else name.removesuffix(path.suffix) + path.suffix
            project.add(names[name], file, image, masks.read(name, area), progress)
            return output

        done = _rendered(inputs.missing(()), len(names), work)
        if not done:
            _print_written(done, len(names))
        project.write_rig()
    _print_written(done, len(names))


def _masks(settings: RenderSettings) -> Masks:
    if not settings.mask_classes:
        return Masks(settings.mask)
    if not isinstance(settings.mask, Path):
        raise SettingError(
            "mask_classes",
            found=", ".join(settings.mask_classes),
            expected="mask=<a folder with labels/ and classes.json> in the same command",
        )
    return class_masks(settings.mask, settings.mask_classes)


def _rows(settings: RenderSettings, inputs: Inputs) -> Iterator[int]:
    """Yield the rows of the whole panoramas; 0 for files that cannot be read."""
    for name, path in inputs.files.items():
        rows, video = 0, inputs.videos.get(name)
        with suppress(DataError, SettingError):
            if video is None or video.value is not None:
                size = read_image_size(path) if video is None else video.value[1:]
                rows = panorama_area(path, size, settings.area).full_shape[0]
        yield rows


def _write_panorama_poses(settings: RenderSettings, model: Path) -> None:
    """Write the poses of the panoramas from a model of COLMAP."""
    output = settings.output or Path()
    check_new(settings, output)
    rig = read_rig((settings.cameras or model.absolute().parent.parent) / RIG_FILE)
    poses = panorama_poses(model, rig)
    write_poses(output, poses)
    print_text(
        f"Written: {output}, poses of {len(poses)} of {counted(len(rig.panoramas), 'panoramas')}"
    )


def _results_jobs(settings: RenderSettings) -> tuple[list[Job], int, _Work]:
    """Return the folders of results, their number, and the function that renders one of them."""
    back, output = settings.back or Path(), settings.output or Path()
    if not back.is_dir():
        raise DataError(back, found="no such folder", expected="a folder of results")
    root = settings.cameras or back
    single = root if root.is_file() else root / CAMERAS_FILE
    names = sorted(path.parent.relative_to(root) for path in root.rglob(CAMERAS_FILE))
    jobs = [
        Job(output / name, back / name, root / name / CAMERAS_FILE)
        for name in names
        if (back / name).is_dir()
    ]
    if single.is_file():
        if output.suffix.lower() not in PIXEL_SUFFIXES:
            raise SettingError(
                "output", found=output, expected=f"a name ending in {', '.join(PIXEL_SUFFIXES)}"
            )
        check_new(settings, output)
        jobs = [Job(output, back, single)]
    if not jobs:
        raise DataError(
            root,
            found=f"no {CAMERAS_FILE}",
            expected="the cameras of the tangent images",
            remedy="Give cameras=<the folder that tangent-render wrote>.",
        )

    def work(job: Job, _: Callable[[float], object]) -> Path:
        path, cameras = job.item, read_cameras(job.value)
        results = TangentResults.read(result_files(job.path, cameras), cameras.grid, settings.kind)
        if not single.is_file():
            path = path.with_name(path.name + results.suffix)
            check_new(settings, path)
        rows = settings.height
        shape = cameras.shape if rows is None else (rows, 2 * rows)
        results.write(path, shape, settings.blend, z_depth=settings.z_depth)
        return Path(path)

    return jobs, len(jobs), work
