"""Generating a data set: rooms in parallel, files whole or not at all, resumable."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from datamodules.core.made_folders import claim_folder
from datamodules.core.processes import in_processes, number_of_processes
from datamodules.core.progress import show_progress
from datamodules.stanford2d3ds.files import AREAS
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
from tangent_train.files import write_bytes, write_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from datamodules.synthrooms.render import Camera

__all__ = ["MANIFEST", "VERSION", "RoomPlan", "generate_rooms", "make_room", "plan_rooms"]

MANIFEST = "synthrooms.json"
"""File that marks a folder as SynthRooms and holds its settings."""

VERSION = 1
"""Version of the generator; another one makes other pictures from the same settings."""

_LABELS = "semantic_labels.json"
_CAMERA_SHARES = (0.75, 0.15, 0.1)  # of rooms with one, two and three cameras
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
            plans.append(_begin(settings, area, numbers[area[0]], len(plans))[0])
    return plans


def _begin(
    settings: RoomSettings, area: str, number: int, order: int
) -> tuple[RoomPlan, np.random.Generator]:
    """A room's plan, and its generator of random numbers after the plan was drawn."""
    seed = settings.seed
    rng = np.random.default_rng((seed, AREAS.index(area), number))
    room = RoomName(area, draw_room_type(rng), number, order)
    drawn = 1 + int(rng.choice(len(_CAMERA_SHARES), p=_CAMERA_SHARES))
    cameras = range(max(settings.least_cameras, drawn))
    return RoomPlan(room, tuple(PictureName.of_camera(seed, room, k) for k in cameras)), rng


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
    number_of_processes(workers, 0)
    claim_folder(root, MANIFEST, "SynthRooms", VERSION, settings.as_dict())
    plans = plan_rooms(settings)
    labels = root / _LABELS
    if not labels.exists():
        write_text(labels, json.dumps(label_strings([plan.name for plan in plans])))
    unfinished = _unfinished(root, plans, settings.views_per_camera)
    if not unfinished:
        return
    pieces = [(root, settings, plan.name) for plan in unfinished]
    making = in_processes(make_room, pieces, number_of_processes(workers, len(pieces)))
    before = len(plans) - len(unfinished)
    show_progress(making, "Making rooms", "rooms", len(plans), before=before, show=progress)


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


def make_room(root: Path, settings: RoomSettings, name: RoomName) -> None:
    """Make a room, take its pictures and write their files.

    Args:
        root: Folder of the data set.
        settings: Settings of the data set.
        name: Which room.
    """
    plan, rng = _begin(settings, name.area, name.number, name.order)
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
