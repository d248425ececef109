from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest

from datamodules.synthrooms.camera import PanoramaView, PerspectiveView, Pose, euler_rotation
from datamodules.synthrooms.render import MISSING, Picture
from datamodules.synthrooms.writer import (
    INSTANCES,
    RoomPlan,
    camera_identifier,
    encode_picture,
    label_indices,
    label_strings,
    pose_record,
)

CAMERA = camera_identifier(0, "5b", "WC_17", 0)
RNG = np.random.default_rng(0)
ROOMS = [
    RoomPlan("1", "office", 1, 0, (), RNG),
    RoomPlan("5b", "WC", 17, 1, (CAMERA,), RNG),
]


def test_every_item_has_its_own_label_until_the_numbers_run_out() -> None:
    items = ["floor", "chair", "<UNK>", "chair", "board", *["board"] * 5]
    table = label_strings(ROOMS)
    names = [table[k] for k in label_indices(ROOMS[1], items)]
    tail = "WC_17_5"
    assert names[:5] == [
        f"floor_1_{tail}",
        f"chair_1_{tail}",
        "<UNK>_0_<UNK>_0_0",
        f"chair_2_{tail}",
        f"board_1_{tail}",
    ]
    assert names[-3:] == [f"board_{INSTANCES['board']}_{tail}"] * 3


def test_pictures_survive_the_files() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (2, 3, 3)).astype(np.uint8)
    depth = np.array([[1.0, np.nan, 2.5], [0.002, 100.0, np.nan]], np.float32)
    items = np.array([[0, MISSING, 1], [2, 1, MISSING]])
    labels = np.array([0, 70_000, 300], np.uint32)
    files = encode_picture(Picture(rgb, depth, items), labels)
    read: dict[str, Any] = {
        kind: cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        for kind, content in files.items()
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
    original = Pose.looking(np.array([1.0, 2.0, 1.5]), 0.7)
    turned = Pose.looking(original.location, -1.2, 0.3, 0.1)
    view = PanoramaView(original, 64) if panorama else PerspectiveView(turned, 100, 1.0)
    frame = "equirectangular" if panorama else "4"
    record = pose_record(ROOMS[1], CAMERA, frame, view, original)
    assert record["camera_uuid"] == record["point_uuid"] == CAMERA
    assert (record["room"], record["frame_num"]) == ("WC_17_5", frame)
    # As the real set's: Blender's camera looks along -z with +y up.
    final = euler_rotation(np.array(record["final_camera_rotation"]))
    rt = np.array(record["camera_rt_matrix"])
    np.testing.assert_allclose(rt[:, :3], np.diag([1, -1, -1]) @ final.T, atol=1e-12)
    np.testing.assert_allclose(rt[:, :3] @ record["camera_location"] + rt[:, 3], 0, atol=1e-12)
    first, turn = (
        euler_rotation(np.array(record[key]))
        for key in ("camera_original_rotation", "rotation_from_original_to_point")
    )
    np.testing.assert_allclose(turn @ first, final, atol=1e-12)
    size = 64 if panorama else 100
    K = np.array(record["camera_k_matrix"])
    assert K[0, 2] == K[1, 2] == size / 2
    assert 2 * math.atan(size / 2 / K[0, 0]) == pytest.approx(record["field_of_view_rads"])
