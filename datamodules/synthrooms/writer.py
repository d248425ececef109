"""Files in Stanford2D3DS's format: names, label table, pictures and poses.

Every picture is four files in ``area_<a>/<pano|data>/<kind>/``, named
``camera_<uuid>_<room>_frame_<frame>_domain_<kind>.<png|json>``. A panorama's frame is
``equirectangular``, a perspective view's is its number.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Sequence
from itertools import product
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.stanford2d3ds.files import CLASSES, MISSING_DEPTH, MISSING_LABEL, UNKNOWN_CLASS
from datamodules.synthrooms.camera import PerspectiveRays, PictureRays, Pose, euler_angles
from datamodules.synthrooms.render import MISSING, Picture

PANORAMA = "equirectangular"
"""Frame of panoramas in file names and poses."""

SUFFIXES = {"rgb": ".png", "depth": ".png", "semantic": ".png", "pose": ".json"}
"""Files of every picture by kind."""

INSTANCES = dict(zip(CLASSES, (8, 4, 4, 1, 24, 40, 4, 4, 1, 4, 8, 8, 4), strict=True))
"""Number of entries per room and class in the label table, used or not.

So the indices of a room do not depend on other rooms. Further instances share the last entry.
"""

_DEPTH_UNITS = 512  # per meter
_NAMESPACE = uuid.UUID("8f2b5b54-6d1f-4a3e-9a44-2d6d0c3f7a10")
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class RoomPlan(NamedTuple):
    """A planned room.

    Attributes:
        area: ``"1"`` to ``"6"``, with ``"5a"`` and ``"5b"``.
        kind: Room type, e.g. ``office``.
        number: Number from 1, unique in the area; 5a and 5b count as one area, as in the real set.
        order: Index of the room in the label table, from 0.
        cameras: Identifier of each of its panoramas, 32 hexadecimal digits.
        rng: Random generator of the room.
    """

    area: str
    kind: str
    number: int
    order: int
    cameras: tuple[str, ...]
    rng: np.random.Generator

    @property
    def name(self) -> str:
        """Room type and number, as in file names."""
        return f"{self.kind}_{self.number}"

    def files(self, frames: Sequence[str]) -> list[PurePosixPath]:
        """Return the paths of all files of some frames, for all cameras, see `file`."""
        every = product(self.cameras, frames, SUFFIXES)
        return [self.file(camera, frame, kind) for camera, frame, kind in every]

    def file(self, camera: str, frame: str, kind: str) -> PurePosixPath:
        """Return the path of a file, relative to the data set's folder.

        Args:
            camera: One of `cameras`.
            frame: `PANORAMA`, or the number of a perspective view.
            kind: One of `SUFFIXES`.
        """
        name = f"camera_{camera}_{self.name}_frame_{frame}_domain_{kind}{SUFFIXES[kind]}"
        group = "pano" if frame == PANORAMA else "data"
        return PurePosixPath(f"area_{self.area}", group, kind, name)


def camera_identifier(seed: int, area: str, room: str, number: int) -> str:
    """Return the identifier of a camera of a room, 32 hexadecimal digits."""
    return uuid.uuid5(_NAMESPACE, f"{seed}/{area}/{room}/{number}").hex


def label_strings(rooms: Sequence[RoomPlan]) -> list[str]:
    """Return the label table: ``class_instance_roomtype_roomnumber_area``, unknown first."""
    labels = [f"{UNKNOWN_CLASS}_0_{UNKNOWN_CLASS}_0_0"]
    for room in rooms:
        labels += [
            f"{name}_{instance}_{room.name}_{room.area[0]}"
            for name, count in INSTANCES.items()
            for instance in range(1, count + 1)
        ]
    return labels


def label_indices(room: RoomPlan, items: Sequence[str]) -> NDArray[np.uint32]:
    """Return index into the label table of every item of a room, ``(n,)``."""
    first = 1 + room.order * sum(INSTANCES.values())
    starts = dict(zip(INSTANCES, np.cumsum([first, *INSTANCES.values()]).tolist(), strict=False))
    seen = dict.fromkeys(INSTANCES, 0)
    indices = np.zeros(len(items), np.uint32)
    for k, name in enumerate(items):
        if name != UNKNOWN_CLASS:
            indices[k] = starts[name] + min(seen[name], INSTANCES[name] - 1)
            seen[name] += 1
    return indices


def encode_picture(picture: Picture, labels: NDArray[np.uint32]) -> dict[str, bytes]:
    """Encode a picture as PNG files.

    Args:
        picture: Rendered picture.
        labels: Index into the label table of every item.

    Returns:
        File content of ``rgb`` (8 bit), ``depth`` (16 bit, 1/512 m, 65535 missing) and
        ``semantic`` (24-bit index R·65536 + G·256 + B, #0D0D0D missing).
    """
    missing = picture.items == MISSING
    index = np.where(missing, MISSING_LABEL, labels[picture.items])
    blue_first = np.stack([index, index >> 8, index >> 16], axis=-1) & 0xFF
    depth = np.nan_to_num(picture.depth_m * _DEPTH_UNITS, nan=MISSING_DEPTH)
    return {
        "rgb": _encode_png(picture.rgb[..., ::-1]),
        "depth": _encode_png(np.clip(depth + 0.5, 0, MISSING_DEPTH).astype(np.uint16)),
        "semantic": _encode_png(blue_first.astype(np.uint8)),
    }


def _encode_png(image: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(image), _PNG)[1].tobytes()


def pose_record(
    room: RoomPlan, camera: str, frame: str, view: PictureRays, original: Pose
) -> dict[str, Any]:
    """Return the pose file of a picture, with all keys of the real set.

    `datamodules.synthrooms.camera` states the formulas. The camera matrix counts from pixel corners
    (the middle of n pixels is n/2), as in the real set. Also as there, a panorama has the field of
    view (90°) and the camera matrix of one cube face.

    Args:
        room: Plan of the room.
        camera: Identifier of one of its cameras.
        frame: `PANORAMA`, or the number of a perspective view.
        view: Camera of the picture.
        original: Pose of the panorama of the same camera.
    """
    pose = view.pose
    image = view
    if not isinstance(image, PerspectiveRays):
        image = PerspectiveRays(pose, image.height, math.pi / 2)
    focal, center = image.size / (2 * math.tan(image.fov_rad / 2)), image.size / 2
    rotation = pose.world_from_camera @ original.world_from_camera.T
    return {
        "camera_k_matrix": [[focal, 0.0, center], [0.0, focal, center], [0.0, 0.0, 1.0]],
        "field_of_view_rads": image.fov_rad,
        "camera_original_rotation": original.euler_angles.tolist(),
        "rotation_from_original_to_point": euler_angles(rotation).tolist(),
        "point_uuid": camera,
        "camera_location": pose.location.tolist(),
        "frame_num": frame,
        "camera_rt_matrix": pose.rt_matrix.tolist(),
        "final_camera_rotation": pose.euler_angles.tolist(),
        "camera_uuid": camera,
        "room": f"{room.name}_{room.area[0]}",
    }
