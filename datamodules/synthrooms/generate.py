"""Generating a data set: rooms in parallel, files whole or not at all, resumable."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from datamodules.progress import show_progress
from datamodules.stanford_files import AREAS
from datamodules.synthrooms.camera import PanoramaView, PerspectiveView, Pose, draw_view
from datamodules.synthrooms.raycast import RayScene
from datamodules.synthrooms.render import draw_camera, draw_holes, render
from datamodules.synthrooms.scene import draw_room_type, furnish
from datamodules.synthrooms.settings import RoomSettings
from datamodules.synthrooms.writer import (
    KINDS,
    PictureName,
    RoomName,
    encode_picture,
    label_indices,
    label_strings,
    pose_record,
)
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_bytes, write_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from datamodules.synthrooms.render import Camera

__all__ = ["MANIFEST", "VERSION", "RoomPlan", "generate_rooms", "make_room", "plan_rooms"]

MANIFEST = "synthrooms.json"
"""File that marks a folder as SynthRooms and holds its settings."""

VERSION = 1
"""Version of the generator; another one makes other pictures from the same settings."""

_LABELS = "semantic_labels.json"
_CAMERA_SHARES = (0.75, 0.15, 0.1)  # of rooms with one, two and three cameras
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_TAILS = {".png": b"IEND\xaeB`\x82", ".json": b"}\n"}


class RoomPlan(NamedTuple):
    """A room before it is made.

    Attributes:
        name: Which room.
        cameras: The panoramas to take.
    """

    name: RoomName
    cameras: tuple[PictureName, ...]

    def files(self, views_per_camera: int) -> Iterator[tuple[PictureName, str]]:
        """Picture and kind of every file of the room."""
        for camera in self.cameras:
            for frame in (None, *range(views_per_camera)):
                for kind in KINDS:
                    yield camera._replace(frame=frame), kind


def plan_rooms(settings: RoomSettings) -> list[RoomPlan]:
    """All rooms of a data set, in the order of the label table."""
    plans: list[RoomPlan] = []
    numbers = dict.fromkeys((area[0] for area in AREAS), 0)
    for area, count in settings.rooms.items():
        for _ in range(count):
            numbers[area[0]] += 1
            plans.append(_begin(settings.seed, area, numbers[area[0]], len(plans))[0])
    return plans


def _begin(seed: int, area: str, number: int, order: int) -> tuple[RoomPlan, np.random.Generator]:
    """A room's plan, and its generator of random numbers after the plan was drawn."""
    rng = np.random.default_rng((seed, AREAS.index(area), number))
    room = RoomName(area, draw_room_type(rng), number, order)
    cameras = 1 + rng.choice(len(_CAMERA_SHARES), p=_CAMERA_SHARES)
    return RoomPlan(room, tuple(PictureName.of_camera(seed, room, k) for k in range(cameras))), rng


def generate_rooms(
    root: Path, settings: RoomSettings, *, workers: int | None = None, progress: bool = True
) -> None:
    """Write a data set in Stanford2D3DS's format; finished rooms are kept.

    The same settings give the same bytes for any number of workers, whether or not the work was
    interrupted. An interrupt leaves whole files only.

    Args:
        root: Folder of the data set: new, empty, or of the same settings.
        settings: What to make.
        workers: Processes; 0 and 1 work in this one. By default one per CPU core.
        progress: Whether to show a progress bar.

    Raises:
        DataError: The folder holds other files, or rooms of other settings. Nothing is written.
        SettingError: The number of workers is negative.
    """
    if workers is not None and workers < 0:
        raise SettingError("workers", found=workers, expected="0 or more, or None")
    _claim(root, settings)
    plans = plan_rooms(settings)
    labels = root / _LABELS
    if not labels.exists():
        write_text(labels, json.dumps(label_strings([plan.name for plan in plans])))
    unfinished = _unfinished(root, plans, settings.views_per_camera)
    if not unfinished:
        return
    processes = min(os.cpu_count() or 1 if workers is None else workers, len(unfinished))
    done = _in_processes if processes > 1 else _in_this_process
    show_progress(
        done(root, settings, unfinished, processes),
        "Making rooms",
        "rooms",
        len(plans),
        before=len(plans) - len(unfinished),
        show=progress,
    )


def _claim(root: Path, settings: RoomSettings) -> None:
    """Make sure that the folder is ours to write to, and mark it."""
    wanted = {"generator": "SynthRooms", "version": VERSION, "settings": settings.as_dict()}
    manifest = root / MANIFEST
    remedy = "Name another folder, or remove this one to make it anew."
    if manifest.exists():
        found = _read_manifest(manifest)
        if found != wanted:
            raise DataError(
                manifest,
                found=_differences(found, wanted),
                expected=_differences(wanted, found),
                remedy=remedy,
            )
        return
    if root.exists():
        if not root.is_dir():
            raise DataError(root, found="a file", expected="a folder", remedy=remedy)
        foreign = sorted(path.name for path in root.iterdir() if not path.name.startswith("."))
        if foreign:
            raise DataError(
                root,
                found=f"files that are not SynthRooms' ({', '.join(foreign[:3])}, …)",
                expected="a new or empty folder",
                remedy="Name another folder.",
            )
    write_text(manifest, json.dumps(wanted, indent=1) + "\n")


def _read_manifest(manifest: Path) -> dict[str, Any]:
    try:
        found = json.loads(manifest.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise DataError(
            manifest,
            found="something else",
            expected="the settings of SynthRooms as JSON",
            remedy="Remove the folder to make it anew.",
        )
    return found


def _differences(one: dict[str, Any], other: dict[str, Any]) -> str:
    """What `one` says that `other` does not."""
    flat, others = _flatten(one), _flatten(other)
    return ", ".join(f"{k}={v}" for k, v in flat.items() if others.get(k) != v) or "nothing more"


def _flatten(manifest: dict[str, Any]) -> dict[str, Any]:
    settings = manifest.get("settings")
    return {**manifest, **(settings if isinstance(settings, dict) else {}), "settings": ""}


def _unfinished(root: Path, plans: Sequence[RoomPlan], views_per_camera: int) -> list[RoomPlan]:
    """Rooms of which a file is missing or broken off."""
    return [
        plan
        for plan in plans
        if not all(_is_whole(root / name.file(kind)) for name, kind in plan.files(views_per_camera))
    ]


def _is_whole(path: Path) -> bool:
    tail = _TAILS[path.suffix]
    try:
        with path.open("rb") as file:
            file.seek(-len(tail), os.SEEK_END)
            return file.read() == tail
    except OSError:
        return False


def _in_this_process(
    root: Path, settings: RoomSettings, plans: Iterable[RoomPlan], processes: int
) -> Iterator[None]:
    del processes
    for plan in plans:
        make_room(root, settings, plan.name)
        yield


def _in_processes(
    root: Path, settings: RoomSettings, plans: Iterable[RoomPlan], processes: int
) -> Iterator[None]:
    """Make rooms in fresh processes; after an interrupt the rooms begun are finished."""
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    context.set_forkserver_preload([__name__])  # imported once, not once per process
    with _one_thread_each(), ProcessPoolExecutor(processes, context, _prepare_worker) as pool:
        try:
            futures = [pool.submit(make_room, root, settings, plan.name) for plan in plans]
            for future in as_completed(futures):
                future.result()
                yield
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that are started inside have one thread of linear algebra each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def _prepare_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what is still done
    cv2.setNumThreads(1)


def make_room(root: Path, settings: RoomSettings, name: RoomName) -> None:
    """Make a room, take its pictures and write their files.

    Args:
        root: Folder of the data set.
        settings: Settings of the data set.
        name: Which room.
    """
    plan, rng = _begin(settings.seed, name.area, name.number, name.order)
    room = furnish(rng, name.kind)
    scene = RayScene(room)
    holes = draw_holes(rng, scene)
    labels = label_indices(name, room.items)
    cameras: list[Camera] = []
    for picture_name in plan.cameras:
        camera = draw_camera(rng, scene, room.plan, cameras)
        cameras.append(camera)
        original = Pose.looking(camera.location, camera.heading)
        views: dict[int | None, PanoramaView | PerspectiveView] = {
            None: PanoramaView(original, settings.height)
        }
        for k in range(settings.views_per_camera):
            views[k] = draw_view(rng, settings.views, camera.location, settings.view_size)
        for frame, view in views.items():
            picture = render(scene, view, camera, holes, settings.supersample, rng)
            full_name = picture_name._replace(frame=frame)
            for kind, content in encode_picture(picture, labels).items():
                write_bytes(root / full_name.file(kind), content)
            pose = json.dumps(pose_record(full_name, view, original)) + "\n"
            write_text(root / full_name.file("pose"), pose)
