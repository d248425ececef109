"""``tangent-render``: write tangent images for other programs, and render their results back."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.folder.class_masks import mask_reader
from tangent_train.cli import main
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import RenderSettings, check_read
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, counted
from tangent_train.files import check_new
from tangent_train.geometry import (
    PanoramaPose,
    PinholeGrid,
    nearest_level,
    perspective_grid,
    to_right_handed,
    view_rotation,
)
from tangent_train.geometry.camera import half_width
from tangent_train.inference.views import HORIZONTAL, view_settings
from tangent_train.io.camera_files import (
    CAMERAS_FILE,
    RIG_FILE,
    CameraFile,
    read_cameras,
    read_rig,
    write_cameras,
    write_poses,
    write_rig,
)
from tangent_train.io.gpano import eye_part, read_area, read_tags, shape_of
from tangent_train.io.image_files import NamedFiles, find_depth
from tangent_train.io.jobs import Inputs, Job, work_on
from tangent_train.io.nerfstudio import write_transforms, write_z_depth
from tangent_train.io.pixel_files import LOSSY_SUFFIXES, read_depth_m, read_image_size
from tangent_train.io.tangent_folders import (
    TangentResults,
    face_name,
    flat_name,
    read_placed,
    result_files,
    write_views,
)
from tangent_train.io.videos import read_video_tags
from tangent_train.keypoints.colmap import is_model, model_points, poses_from
from tangent_train.manifest import Manifest
from tangent_train.rendering.representations.pinhole import ring_size
from tangent_train.rendering.resampling import resize


def render(settings: RenderSettings) -> None:
    """Render panoramas to tangent images, or results for tangent images to panoramas.

    Raises:
        DataError: No files to render are found.
        SettingError: A setting is invalid, or the output was written with other settings.
    """
    modes = [name for name in _MODES if getattr(settings, name) is not None]
    modes = ["input"] if settings.nerfstudio else modes
    if len(modes) != 1:
        found = " and ".join(modes) or "none of them"
        expected = "input=<panoramas>, back=<results> or poses=<a model of COLMAP>"
        remedy = "Example: tangent-render input=panoramas output=tangent"
        raise SettingError("input, back and poses", found=found, expected=expected, remedy=remedy)
    run, read = _MODES[modes[0]]
    read = read | (_OF_PROJECTS if settings.colmap or settings.nerfstudio else set())
    read |= _OF_NERFSTUDIO if settings.nerfstudio else set()
    check_read(settings, {*read, *modes, "output", "overwrite"})
    run(settings, settings.model_dump(mode="json", exclude={*settings.not_content}))


def _render_views(settings: RenderSettings, content: Mapping[str, Any]) -> None:
    """Render panoramas to folders of tangent images, or to one project for COLMAP."""
    inputs = Inputs.find(settings.input or "", settings.every, settings.eye, settings.area)
    output, kind, suffix = settings.output, settings.interpolation, f".{settings.format}"
    if kind == "nearest" and suffix in LOSSY_SUFFIXES:
        expected = "png, tif or npy with interpolation=nearest: other formats change pixels"
        raise SettingError("format", found=settings.format, expected=expected)
    cameras = _cameras(settings, 512)  # refuses views before any panorama
    names, masks = inputs.names, mask_reader(None, None)
    is_project = settings.colmap or settings.nerfstudio
    poses, points = _world(settings, names) if settings.nerfstudio else ({}, None)
    distances = NamedFiles(settings.depth) if settings.depth else None
    if is_project:  # a camera has images of one size
        rows = _most_rows(settings, inputs)
        cameras = _cameras(settings, rows)
        masks = mask_reader(settings.mask, settings.mask_classes)
        content = {**content, "level": _level(settings, rows)}
    rig = {f"{Path(file).stem}/": cameras.views[face] for file, face in cameras.items}
    manifest = Manifest.open(output, content)

    def work(job: Job, progress: Callable[[float], object]) -> None:
        source = job.path, kind, settings.area, job.value, settings.depth_channel, settings.eye
        image, area = read_placed(*source)
        shape = image.shape[0], image.shape[1]
        if is_project:
            end = f"{flat_name(job.name)}{suffix}"
            images, of_images, depths = (
                {output / folder / (prefix + name): view for prefix, view in rig.items()}
                for folder, name in (
                    ("images", end),
                    ("masks", end + ".png"),
                    ("depths", end + ".png"),
                )
            )
            write_views(image, images, kind, progress)
            write_views(masks(job.name, area), of_images, "nearest", lambda _: None)
            if distances is not None:
                path = find_depth(distances, job.name, "")
                depth = read_depth_m(path, settings.depth_scale, settings.depth_channel)
                write_z_depth(area.place(resize(depth, area.image_shape, "nearest")), depths)
            return
        of_panorama = replace(_cameras(settings, shape[0]), source=job.path.name, shape=shape)
        folder, views = output / job.name, of_panorama.views
        paths = {folder / file: views[face] for file, face in of_panorama.items}
        write_views(image, paths, kind, progress)
        write_cameras(folder / CAMERAS_FILE, of_panorama)

    failed = _render_missing(manifest, names, inputs.jobs, work)
    if is_project:
        done = {name: manifest.finished[name] for name in names if name in manifest.finished}
        panoramas = {f"{flat_name(name)}{suffix}": item["file"] for name, item in done.items()}
        write_rig(output / RIG_FILE, rig, panoramas)
        posed = {end: poses.get(file) or poses.get("") for end, file in panoramas.items()}
    if settings.nerfstudio:
        write_transforms(output, rig, posed, points)
    _print_written(output, names, failed)


def _world(settings: RenderSettings, names: Sequence[str]) -> tuple[dict[str, PanoramaPose], Any]:
    """Return poses of panoramas by file, and the points of a COLMAP model or None.

    A single panorama, called "", defines the world.
    """
    if (path := settings.poses) is not None:
        return _poses(settings, path), model_points(path) if is_model(path) else None
    if len(names) > 1:
        expected = f"poses of the {len(names)} panoramas: a COLMAP model, or a JSON file"
        raise SettingError("poses", found="null", expected=expected)
    return {"": PanoramaPose(to_right_handed(np.eye(3)), np.zeros(3))}, None


def _render_missing(
    manifest: Manifest,
    names: Sequence[str],
    jobs: Callable[[list[str]], Iterable[Job]],
    work: Callable[[Job, Callable[[float], object]], object],
) -> int:
    """Render what is missing in a folder; return the number of panoramas that failed."""
    missing = manifest.missing(names)
    print_text(f"{counted(len(names), 'panoramas')}, {len(names) - len(missing)} done already.")
    for job in work_on("Rendering", jobs(missing), len(missing), work):
        if not job.error:  # of a frame, its name; else the file below the input
            suffix = job.path.suffix
            file = job.name if job.is_frame else job.name.removesuffix(suffix) + suffix
            manifest.finish(job.name, file=file)
    return len(manifest.missing(names))


def _poses(settings: RenderSettings, path: Path) -> dict[str, PanoramaPose]:
    """Return the poses of panoramas by file."""
    return {file: pose for file, (pose, _) in poses_from(path, settings.cameras).items()}


def _print_written(output: Path, names: Sequence[str], failed: int) -> None:
    if failed < len(names):
        print_text(f"Results are in {output}.")
    if failed:
        text = f"{failed} of {len(names)} panoramas could not be rendered, see above"
        sys.exit(f"tangent-render: {text}")


def _cameras(settings: RenderSettings, rows: int) -> CameraFile:
    """Return the images to write of a panorama with some rows; source and shape are not set."""
    grids = _grids(settings, _level(settings, rows))
    if settings.rotation is not None:  # x forward, y to the right, z up
        rotation = view_rotation(*settings.rotation)
        grids = [grid.with_rotation(rotation) for grid in grids]
    count = sum(grid.num_images for grid in grids)
    faces = range(count) if settings.faces is None else settings.faces
    try:
        indices = tuple(range(count)[face] for face in faces)
    except IndexError as error:
        expected = f"indices of the {count} images, from 0"
        raise SettingError("faces", found=list(faces), expected=expected) from error
    files = tuple(f"{face_name(face, count)}.{settings.format}" for face in indices)
    return CameraFile("", (0, 0), grids[0], indices, files, tuple(grids[1:]))


def _level(settings: RenderSettings, rows: int) -> int:
    return nearest_level(rows) if settings.level is None else settings.level


def _grids(settings: RenderSettings, level: int) -> Sequence[PinholeGrid]:
    """Return the images, which need not cover the sphere; one grid for each field of view."""
    given = {name: getattr(settings, name) for name in _DIRECTIONS}
    others = {"base_level": settings.base_level, "dim": settings.dim}
    if any(value is not None for value in given.values()):
        for name, value in {"views": settings.views, **others}.items():
            if value is not None:
                expected = "null beside yaw, pitch, roll, fov or size"
                raise SettingError(name, found=value, expected=expected)
        fov = 90.0 if settings.fov is None else settings.fov
        pair = fov if isinstance(fov, tuple) else (fov, fov)
        columns = ring_size(level, pair)[1]
        rows = math.ceil(columns * half_width(pair[1]) / half_width(pair[0]) - 1e-9)
        size = settings.size or (columns, rows)
        yaw, pitch, roll = (0.0 if given[name] is None else given[name] for name in _DIRECTIONS[:3])
        grids: Sequence[PinholeGrid] = [perspective_grid(yaw, pitch, fov, size, roll)]
    else:
        section = view_settings(settings.views or {"option": "tangent", "base_level": 1})
        known = {name: value for name, value in others.items() if value is not None}
        section |= {"level": level, **known}
        if section["_target_"] == HORIZONTAL:
            section["_target_"] = _SEPARATE
        grids = getattr(build_from_config(section, "views"), "grids", ())
        if not grids:
            expected = "tangent, cubemap or an option that begins with horizontal"
            raise SettingError("views", found=settings.views, expected=expected)
    return grids


def _most_rows(settings: RenderSettings, inputs: Inputs) -> int:
    """Return the rows of the largest panorama; files that cannot be read fail later."""
    sizes = {video.path: video.size[1:] for video in inputs.videos.values()}
    rows, area = [], settings.area
    for path in [*sizes, *inputs.images.values()]:
        with suppress(DataError, SettingError):
            tags = read_video_tags(path) if path in sizes else read_tags(path)
            size = sizes.get(path) or read_image_size(path)
            if path not in sizes:
                size = shape_of(size, eye_part(path, size, settings.eye, area, tags))
            rows.append(read_area(path, size, area, tags=tags).full_shape[0])
    return max(rows, default=512)


def _write_poses(settings: RenderSettings, _: Mapping[str, Any]) -> None:
    """Write the poses of the panoramas from a model of COLMAP."""
    model, output = settings.poses or Path(), settings.output
    check_new(output, overwrite=settings.overwrite)
    rig = read_rig((settings.cameras or model.absolute().parent.parent) / RIG_FILE)
    poses = _poses(settings, model)
    write_poses(output, poses)
    count = counted(len(rig.panoramas), "panoramas")
    print_text(f"Written: {output}, poses of {len(poses)} of {count}")


def _render_back(settings: RenderSettings, content: Mapping[str, Any]) -> None:
    """Render the results of one panorama to a file, or those of a folder of panoramas."""
    back, output = settings.back or Path(), settings.output
    root = settings.cameras or back

    def write(folder: Path, cameras_file: Path, path: Path, *, adds_suffix: bool = False) -> None:
        cameras = read_cameras(cameras_file)
        of_files = settings.kind, settings.depth_channel
        results = TangentResults.read(result_files(folder, cameras), cameras.grid, *of_files)
        rows = settings.height
        shape = cameras.shape if rows is None else (rows, 2 * rows)
        path = path.with_name(path.name + results.suffix) if adds_suffix else path
        lost = results.write(path, shape, settings.blend, z_depth=settings.z_depth)
        if lost:
            reason = "distances beyond its integers are unknown (0); give depth as floats"
            print_text(f"{path}: {counted(lost, 'pixels')}: {reason}", error=True)

    single = root if root.is_file() else root / CAMERAS_FILE
    if single.is_file():
        check_new(output, overwrite=settings.overwrite)
        write(back, single, output)
        print_text(f"Written: {output}")
        return
    found = sorted(path.parent.relative_to(root) for path in root.rglob(CAMERAS_FILE))
    folders = {str(name): back / name for name in found if (back / name).is_dir()}
    if not folders:
        remedy = "Give cameras=<the folder that tangent-render wrote>."
        expected = "the cameras of the tangent images"
        raise DataError(root, found=f"no {CAMERAS_FILE}", expected=expected, remedy=remedy)

    def work(job: Job, _: Callable[[float], object]) -> None:
        write(job.path, root / job.name / CAMERAS_FILE, output / job.name, adds_suffix=True)

    def jobs(names: Sequence[str]) -> list[Job]:
        return [Job(name, folders[name]) for name in names]

    failed = _render_missing(Manifest.open(output, content), [*folders], jobs, work)
    _print_written(output, [*folders], failed)


_DIRECTIONS = ("yaw", "pitch", "roll", "fov", "size")
"""Settings of views in given directions."""

_MODES: dict[str, tuple[Callable[[RenderSettings, Mapping[str, Any]], None], set[str]]] = {
    "input": (
        _render_views,
        {"every", "area", "eye", "views", "base_level", "level", "dim", "faces", "rotation"}
        | {*_DIRECTIONS, "format"}
        | {"interpolation", "colmap", "nerfstudio", "depth_channel"},
    ),
    "back": (_render_back, {"cameras", "blend", "height", "kind", "depth_channel", "z_depth"}),
    "poses": (_write_poses, {"cameras"}),
}
"""Function of each mode, and the settings that it reads."""

_OF_PROJECTS = {"mask", "mask_classes"}
_OF_NERFSTUDIO = {"poses", "cameras", "depth", "depth_scale"}
"""Settings that are read with colmap=true or nerfstudio=true, and with the latter only."""

_SEPARATE = "tangent_train.rendering.representations.pinhole.SeparateViews"

if __name__ == "__main__":
    main.render()
