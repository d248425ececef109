"""SynthRooms: rooms generated in Stanford2D3DS's format, in parallel and resumable.

They are read by the data modules of Stanford2D3DS, after generating the files. Every picture is
four files in ``area_<a>/<pano|data>/<kind>/``, named
``camera_<uuid>_<room>_frame_<frame>_domain_<kind>.<png|json>``. A panorama's frame is
``equirectangular``, a perspective view's is its number.
"""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, NonNegativeInt, PositiveInt
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from datamodules.core.data_module import data_set
from datamodules.stanford2d3ds import files as stanford
from datamodules.stanford2d3ds.pairs import StanfordPairs
from datamodules.stanford2d3ds.panoramas import (
    Stanford2D3DS,
    Stanford2D3DSPerspective,
    StanfordImages,
)
from datamodules.synthrooms import render
from datamodules.synthrooms.furniture import build_room, draw_room_type
from tangent_train.files import write_bytes, write_text
from tangent_train.manifest import Manifest
from tangent_train.progress import show_progress
from tangent_train.threads import in_processes

INSTANCES = dict(zip(stanford.CLASSES, (8, 4, 4, 1, 24, 40, 4, 4, 1, 4, 8, 8, 4), strict=True))
"""Number of entries per room and class in the label table, used or not.

So the indices of a room do not depend on other rooms. Further instances share the last entry.
"""

PANORAMA = "equirectangular"
"""Frame of panoramas in file names and poses."""

_VERSION = 1  # other versions render other pictures from the same settings
_CAMERA_SHARES = (0.75, 0.15, 0.1)  # shares of rooms with one, two and three cameras
_DEPTH_UNITS = 512  # per meter
_NAMESPACE = uuid.UUID("8f2b5b54-6d1f-4a3e-9a44-2d6d0c3f7a10")
_AreaName = Annotated[stanford.Area, BeforeValidator(lambda name: str(name).removeprefix("area_"))]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid"))
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
    """

    seed: NonNegativeInt = 0
    rooms: Mapping[_AreaName, NonNegativeInt]
    height: Annotated[int, Field(ge=8)] = 512
    views: render.ViewKind = "stanford"
    views_per_camera: NonNegativeInt = 0
    view_size: Annotated[int, Field(ge=8)] = 540
    supersample: PositiveInt = 2
    least_cameras: PositiveInt = 1

    @property
    def areas(self) -> list[stanford.Area]:
        """The areas that have rooms."""
        return [area for area in stanford.AREAS if self.rooms.get(area)]


class RoomPlan(NamedTuple):
    """A planned room.

    Attributes:
        area: ``"1"`` to ``"6"``, with ``"5a"`` and ``"5b"``.
        name: Room type and number from 1, e.g. ``office_7``; numbers are unique in an area, and 5a
            and 5b count as one area, as in the real set.
        order: Index of the room in the label table, from 0.
        cameras: Identifier of each of its panoramas, 32 hexadecimal digits.
        rng: Random generator of the room.
    """

    area: str
    name: str
    order: int
    cameras: Sequence[str]
    rng: np.random.Generator


def plan_rooms(settings: RoomSettings) -> list[RoomPlan]:
    """Return all rooms of a data set, in the order of the label table."""
    plans: list[RoomPlan] = []
    numbers = {area[0]: 0 for area in stanford.AREAS}
    for area in chain.from_iterable([area] * settings.rooms[area] for area in settings.areas):
        number = numbers[area[0]] = numbers[area[0]] + 1
        rng = np.random.default_rng((settings.seed, stanford.AREAS.index(area), number))
        name = f"{draw_room_type(rng)}_{number}"
        drawn = 1 + int(rng.choice(len(_CAMERA_SHARES), p=_CAMERA_SHARES))
        cameras = [
            uuid.uuid5(_NAMESPACE, f"{settings.seed}/{area}/{name}/{k}").hex
            for k in range(max(settings.least_cameras, drawn))
        ]
        plans.append(RoomPlan(area, name, len(plans), cameras, rng))
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
        SettingError: The folder holds other files, or rooms of other settings.
    """
    about = {"generator": "SynthRooms", "version": _VERSION}
    manifest = Manifest.open(root, about | asdict(settings), is_shared=True)
    plans = {f"area_{plan.area}/{plan.name}": plan for plan in plan_rooms(settings)}
    missing = manifest.missing(plans)
    if missing:
        write_text(root / "semantic_labels.json", json.dumps(label_strings([*plans.values()])))
    pieces = [(root, settings, plans[name], name) for name in missing]
    finished = map(manifest.finish, in_processes(make_room, pieces, workers))
    show_progress(finished, "Rendering rooms", "rooms", len(plans), len(plans) - len(missing))


def make_room(root: Path, settings: RoomSettings, plan: RoomPlan, name: str) -> str:
    """Furnish a room, render its pictures and write their files.

    Args:
        root: Folder of the data set.
        settings: Settings of the data set.
        plan: Plan of the room.
        name: Name of the room in the manifest, which is returned.
    """
    rng = plan.rng
    room = build_room(rng, plan.name.partition("_")[0])
    scene = render.RayScene(room)
    holes = render.draw_holes(scene)
    labels = label_indices(plan, room.items)
    cameras: list[render.Camera] = []
    for identifier in plan.cameras:
        camera = render.draw_camera(scene, cameras)
        cameras.append(camera)
        panorama = render.View.looking(camera.location, settings.height, heading=camera.heading)
        views = {PANORAMA: panorama}
        for k in range(settings.views_per_camera):
            views[str(k)] = render.draw_view(
                rng, settings.views, camera.location, settings.view_size
            )
        for frame, view in views.items():
            picture = render.render_picture(scene, view, camera, holes, settings.supersample)
            files = encode_picture(picture, labels)
            pose = pose_record(plan, identifier, frame, view, panorama)
            files["pose.json"] = json.dumps(pose).encode() + b"\n"
            folder = root / f"area_{plan.area}" / ("pano" if frame == PANORAMA else "data")
            for end, content in files.items():
                file = f"camera_{identifier}_{plan.name}_frame_{frame}_domain_{end}"
                write_bytes(folder / end.partition(".")[0] / file, content)
    return name


def label_strings(rooms: Sequence[RoomPlan]) -> list[str]:
    """Return the label table: ``class_instance_roomtype_roomnumber_area``, unknown first."""
    return [f"{stanford.UNKNOWN_CLASS}_0_{stanford.UNKNOWN_CLASS}_0_0"] + [
        f"{name}_{instance}_{room.name}_{room.area[0]}"
        for room in rooms
        for name, count in INSTANCES.items()
        for instance in range(1, count + 1)
    ]


def label_indices(room: RoomPlan, items: Sequence[str]) -> NDArray[np.uint32]:
    """Return index into the label table of every item of a room, ``(n,)``."""
    first = 1 + room.order * sum(INSTANCES.values())
    starts = dict(zip(INSTANCES, np.cumsum([first, *INSTANCES.values()]).tolist(), strict=False))
    seen = dict.fromkeys(INSTANCES, 0)
    indices = np.zeros(len(items), np.uint32)
    for k, name in enumerate(items):
        if name != stanford.UNKNOWN_CLASS:
            indices[k] = starts[name] + min(seen[name], INSTANCES[name] - 1)
            seen[name] += 1
    return indices


def encode_picture(picture: render.Picture, labels: NDArray[np.uint32]) -> dict[str, bytes]:
    """Encode a picture as PNG files.

    Args:
        picture: Rendered picture.
        labels: Index into the label table of every item.

    Returns:
        File content of ``rgb.png`` (8 bit), ``depth.png`` (16 bit, 1/512 m, 65535 missing) and
        ``semantic.png`` (24-bit index R·65536 + G·256 + B, #0D0D0D missing).
    """
    index = np.where(picture.items == render.MISSING, stanford.MISSING_LABEL, labels[picture.items])
    blue_first = np.stack([index, index >> 8, index >> 16], axis=-1) & 0xFF
    depth = np.nan_to_num(picture.depth_m * _DEPTH_UNITS, nan=stanford.MISSING_DEPTH)
    images: dict[str, NDArray[Any]] = {
        "rgb.png": np.ascontiguousarray(picture.rgb[..., ::-1]),
        "depth.png": np.clip(depth + 0.5, 0, stanford.MISSING_DEPTH).astype(np.uint16),
        "semantic.png": blue_first.astype(np.uint8),
    }
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return {end: cv2.imencode(".png", image, fast)[1].tobytes() for end, image in images.items()}


def pose_record(
    room: RoomPlan, camera: str, frame: str, view: render.View, panorama: render.View
) -> dict[str, Any]:
    """Return the pose file of a picture, with all keys of the real set.

    `datamodules.stanford2d3ds.files` states the formulas. The camera matrix counts from pixel
    corners (the middle of n pixels is n/2), as in the real set. Also as there, a panorama has the
    field of view (90°) and the camera matrix of one cube face.

    Args:
        room: Plan of the room.
        camera: Identifier of one of its cameras.
        frame: `PANORAMA`, or the number of a perspective view.
        view: render.Picture.
        panorama: Panorama of the same camera.
    """
    fov_rad = view.fov_rad or math.pi / 2
    focal, center = view.size / (2 * math.tan(fov_rad / 2)), view.size / 2
    rotation, original = view.world_from_camera, panorama.world_from_camera
    turns = (original @ stanford.BLENDER, rotation @ original.T, rotation @ stanford.BLENDER)
    first, between, last = Rotation.from_matrix(turns).as_euler("xyz").tolist()
    room_to_camera = np.hstack([rotation.T, -(rotation.T @ view.location)[:, None]])
    return {
        "camera_k_matrix": [[focal, 0.0, center], [0.0, focal, center], [0.0, 0.0, 1.0]],
        "field_of_view_rads": fov_rad,
        "camera_original_rotation": first,
        "rotation_from_original_to_point": between,
        "point_uuid": camera,
        "camera_location": view.location.tolist(),
        "frame_num": frame,
        "camera_rt_matrix": room_to_camera.tolist(),
        "final_camera_rotation": last,
        "camera_uuid": camera,
        "room": f"{room.name}_{room.area[0]}",
    }


@data_set
class SynthRoomsImages(StanfordImages):
    """Images of synthetic rooms, generated on first use.

    Args:
        rooms: Rooms to generate; their areas are the areas used.
    """

    areas: Any = field(init=False, default=())
    rooms: RoomSettings

    def __post_init__(self) -> None:
        self.areas = self.rooms.areas
        super().__post_init__()

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_rooms(self.root, self.rooms)


@data_set
class SynthRooms(SynthRoomsImages, Stanford2D3DS):
    """Panoramas of synthetic rooms, read as Stanford2D3DS: the data set that needs no download."""


@data_set
class SynthRoomsPerspective(SynthRoomsImages, Stanford2D3DSPerspective):
    """Photos of synthetic rooms, read as those of Stanford2D3DS; set ``rooms.views_per_camera``."""


@data_set
class SynthRoomsPairs(StanfordPairs):
    """Any two panoramas of the same synthetic room, with exact depth and pose.

    Pairs are not divided into easy and hard, because overlaps are known only afterwards.

    Args:
        rooms: Rooms to generate, with two cameras or more.
    """

    selection: Any = field(init=False, default="rooms")
    areas: Any = field(init=False, default=None)
    rooms: RoomSettings

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_rooms(self.root, self.rooms)
