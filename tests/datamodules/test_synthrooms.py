from __future__ import annotations

import math
from collections import Counter
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datamodules.stanford2d3ds.files import UNKNOWN_CLASS
from datamodules.synthrooms.datamodule import (
    INSTANCES,
    RoomPlan,
    SynthRooms,
    encode_picture,
    pose_record,
)
from datamodules.synthrooms.furniture import build_room, draw_room_type
from datamodules.synthrooms.render import (
    MISSING,
    Picture,
    RayScene,
    View,
    draw_camera,
    draw_holes,
    render_picture,
)
from datamodules.synthrooms.room import Room
from tangent_train.errors import SettingError


def test_impossible_settings_are_named() -> None:
    with pytest.raises(SettingError, match=r"data\.rooms.*: found 7; expected '1', "):
        SynthRooms("rooms", rooms={"rooms": {"7": 1}})  # type: ignore[arg-type]


SEEDS = range(60)


@pytest.fixture(scope="module")
def rooms() -> list[Room]:
    made = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        made.append(build_room(rng, draw_room_type(rng)))
    return made


def test_everything_stands_inside(rooms: list[Room]) -> None:
    for room in rooms:
        corners = np.concatenate([part.triangles.reshape(-1, 3) for part in room.parts])
        size = (room.plan.width, room.plan.depth, room.plan.height)
        # Walls are 10 cm thick; bases of columns at walls reach a little further into them.
        assert (corners > -0.13).all()
        assert (corners < np.add(size, 0.13)).all()


def test_every_class_covers_enough_pixels_in_enough_rooms(rooms: list[Room]) -> None:
    pixels, present = Counter[str](), Counter[str]()
    missing = 0
    for room in rooms:
        scene = RayScene(room)
        holes = draw_holes(scene)
        camera = draw_camera(scene)
        view = View.looking(camera.location, 32, heading=camera.heading)
        items = render_picture(scene, view, camera, holes, 1).items
        seen = Counter(room.items[k] for k in items[items != MISSING])
        pixels += seen
        present.update(seen.keys())
        missing += int((items == MISSING).sum())
    total = missing + pixels.total()
    assert min(pixels[name] / total for name in INSTANCES) > 0.01, pixels
    assert min(present[name] / len(rooms) for name in INSTANCES) > 0.45, present
    assert pixels[UNKNOWN_CLASS] > 0
    assert 0.02 < missing / total < 0.15


CAMERA = "0f" * 16
RNG = np.random.default_rng(0)
ROOMS = [
    RoomPlan("1", "office_1", 0, [], RNG),
    RoomPlan("5b", "WC_17", 1, [CAMERA], RNG),
]


def test_pictures_survive_the_files() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (2, 3, 3)).astype(np.uint8)
    depth = np.array([[1.0, np.nan, 2.5], [0.002, 100.0, np.nan]], np.float32)
    items = np.array([[0, MISSING, 1], [2, 1, MISSING]])
    labels = np.array([0, 70_000, 300], np.uint32)
    files = encode_picture(Picture(rgb, depth, items), labels)
    read: dict[str, Any] = {
        name.removesuffix(".png"): cv2.imdecode(
            np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED
        )
        for name, content in files.items()
    }
    np.testing.assert_array_equal(read["rgb"][..., ::-1], rgb)
    assert read["depth"].dtype == np.uint16
    assert read["depth"].tolist() == [[512, 65535, 1280], [1, 51200, 65535]]
    blue, green, red = np.moveaxis(read["semantic"].astype(int), -1, 0)
    assert (red * 65536 + green * 256 + blue).tolist() == [
        [0, 855309, 70_000],
        [300, 70_000, 855309],
    ]


@pytest.mark.parametrize("panorama", [True, False])
def test_poses_have_every_key_and_agree_with_themselves(panorama: bool) -> None:
    original = View.looking(np.array([1.0, 2.0, 1.5]), 64, heading=0.7)
    photo = View.looking(original.location, 100, 1.0, heading=-1.2, pitch=0.3, roll=0.1)
    view = original if panorama else photo
    frame = "equirectangular" if panorama else "4"
    record = pose_record(ROOMS[1], CAMERA, frame, view, original)
    assert record["camera_uuid"] == record["point_uuid"] == CAMERA
    assert (record["room"], record["frame_num"]) == ("WC_17_5", frame)
    # As the real set's: Blender's camera looks along -z with +y up.
    first, between, final = Rotation.from_euler(
        "xyz",
        [
            record["camera_original_rotation"],
            record["rotation_from_original_to_point"],
            record["final_camera_rotation"],
        ],
    ).as_matrix()
    rt = np.array(record["camera_rt_matrix"])
    np.testing.assert_allclose(rt[:, :3], np.diag([1, -1, -1]) @ final.T, atol=1e-12)
    np.testing.assert_allclose(rt[:, :3] @ record["camera_location"] + rt[:, 3], 0, atol=1e-12)
    np.testing.assert_allclose(between @ first, final, atol=1e-12)
    size = 64 if panorama else 100
    K = np.array(record["camera_k_matrix"])
    assert K[0, 2] == K[1, 2] == size / 2
    assert 2 * math.atan(size / 2 / K[0, 0]) == pytest.approx(record["field_of_view_rads"])
