"""Generating a data set: rooms in parallel, each file written atomically; resumable."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np

from datamodules.core.made_folders import claim_folder
from datamodules.core.processes import in_processes
from datamodules.stanford2d3ds.files import AREAS
from datamodules.synthrooms import writer
from datamodules.synthrooms.camera import PanoramaRays, PictureRays, Pose, ViewKind, draw_rays
from datamodules.synthrooms.raycast import RayScene
from datamodules.synthrooms.render import Camera, draw_camera, draw_holes, render_picture
from datamodules.synthrooms.scene import draw_room_type, furnish
from tangent_train.errors import SettingError, at_least
from tangent_train.files import write_bytes, write_text
from tangent_train.progress import show_progress

MANIFEST = "synthrooms.json"
"""File that marks a folder as SynthRooms and holds its settings."""

_VERSION = 1
"""Version of the generator; other versions render other pictures from the same settings."""

_LEAST = {"height": 8, "view_size": 8, "supersample": 1, "least_cameras": 1}
_CAMERA_SHARES = (0.75, 0.15, 0.1)  # shares of rooms with one, two and three cameras


@dataclass(frozen=True)
class RoomSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything, 0 or more.
        rooms: Number of rooms per area (a subset of `AREAS`, also written ``area_5a``).
        height: Rows of the panoramas; they have twice as many columns.
        views: Viewing directions of photos: ``"stanford"`` upright as in the real set (pitch
            about N(0, 20°)), ``"uniform"`` in directions uniform on the sphere; both have fields of
            view of 45° to 75°. ``"wide"``: upright, 96° to 106° (pitch about N(0, 35°)).
        views_per_camera: Perspective views per panorama.
        view_size: Side of the square perspective views in pixels.
        supersample: Rays per pixel side for the colors (labels and depth: one ray at the center).
        least_cameras: Smallest number of panoramas per room; by default most rooms have one.

    Raises:
        SettingError: A setting is invalid.
    """

    seed: int = 0
    rooms: Mapping[str, int] = field(
        default_factory=lambda: {a: 16 if a[0] == "5" else 40 for a in AREAS}
    )
    height: int = 512
    views: ViewKind = "stanford"
    views_per_camera: int = 0
    view_size: int = 540
    supersample: int = 2
    least_cameras: int = 1

    @classmethod
    def of(cls, given: RoomSettings | Mapping[str, Any]) -> RoomSettings:
        """Return settings from a config."""
        return given if isinstance(given, RoomSettings) else cls(**given)

    def __post_init__(self) -> None:
        rooms = {str(area).removeprefix("area_"): count for area, count in self.rooms.items()}
        if not set(rooms) <= set(AREAS) or not any(rooms.values()):
            raise SettingError("rooms", found=rooms, expected=f"numbers of rooms by area: {AREAS}")
        object.__setattr__(self, "rooms", {area: rooms[area] for area in AREAS if area in rooms})
        if self.views not in get_args(ViewKind):
            raise SettingError("views", found=self.views, expected=get_args(ViewKind))
        numbers = {f"rooms[{area}]": count for area, count in rooms.items()}
        names = ("seed", "views_per_camera", *_LEAST)
        for name, value in {**numbers, **{name: getattr(self, name) for name in names}}.items():
            at_least(name, value, _LEAST.get(name, 0))

    @property
    def areas(self) -> list[str]:
        """The areas that have rooms."""
        return [area for area, count in self.rooms.items() if count]


def plan_rooms(settings: RoomSettings) -> list[writer.RoomPlan]:
    """Return all rooms of a data set, in the order of the label table."""
    plans: list[writer.RoomPlan] = []
    numbers = {area[0]: 0 for area in AREAS}
    for area in (area for area, count in settings.rooms.items() for _ in range(count)):
        number = numbers[area[0]] = numbers[area[0]] + 1
        rng = np.random.default_rng((settings.seed, AREAS.index(area), number))
        kind = draw_room_type(rng)
        drawn = 1 + int(rng.choice(len(_CAMERA_SHARES), p=_CAMERA_SHARES))
        cameras = tuple(
            writer.camera_identifier(settings.seed, area, f"{kind}_{number}", k)
            for k in range(max(settings.least_cameras, drawn))
        )
        plans.append(writer.RoomPlan(area, kind, number, len(plans), cameras, rng))
    return plans


def generate_rooms(root: Path, settings: RoomSettings, *, workers: int | None = None) -> None:
    """Write a data set in Stanford2D3DS's format; finished rooms are kept.

    The same settings give the same bytes for any number of workers, whether or not the work was
    interrupted.

    Args:
        root: Folder of the data set: new, empty, or generated with the same settings.
        settings: Settings of the generator.
        workers: Number of processes, by default one per CPU core; 0 and 1 mean this process.

    Raises:
        DataError: The folder holds other files, or rooms of other settings; nothing is written.
    """
    claim_folder(root, MANIFEST, "SynthRooms", _VERSION, asdict(settings))
    plans = plan_rooms(settings)
    labels = root / "semantic_labels.json"
    if not labels.exists():
        write_text(labels, json.dumps(writer.label_strings(plans)))
    frames = (writer.PANORAMA, *map(str, range(settings.views_per_camera)))
    unfinished = [
        plan for plan in plans if not all((root / file).exists() for file in plan.files(frames))
    ]
    making = in_processes(make_room, [(root, settings, plan) for plan in unfinished], workers)
    before = len(plans) - len(unfinished)
    show_progress(making, "Rendering rooms", "rooms", len(plans), before)


def make_room(root: Path, settings: RoomSettings, plan: writer.RoomPlan) -> None:
    """Furnish a room, render its pictures and write their files.

    Args:
        root: Folder of the data set.
        settings: Settings of the data set.
        plan: Plan of the room.
    """
    rng = plan.rng
    room = furnish(rng, plan.kind)
    scene = RayScene(room)
    holes = draw_holes(rng, scene)
    labels = writer.label_indices(plan, room.items)
    cameras: list[Camera] = []
    for identifier in plan.cameras:
        camera = draw_camera(rng, scene, room.plan, cameras)
        cameras.append(camera)
        original = Pose.looking(camera.location, camera.heading)
        views: dict[str, PictureRays] = {writer.PANORAMA: PanoramaRays(original, settings.height)}
        for k in range(settings.views_per_camera):
            views[str(k)] = draw_rays(rng, settings.views, camera.location, settings.view_size)
        for frame, view in views.items():
            picture = render_picture(scene, view, camera, holes, settings.supersample, rng)
            files = writer.encode_picture(picture, labels)
            pose = writer.pose_record(plan, identifier, frame, view, original)
            files["pose"] = json.dumps(pose).encode() + b"\n"
            for kind, content in files.items():
                write_bytes(root / plan.file(identifier, frame, kind), content)
