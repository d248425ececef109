"""Two real panoramas, taken above each other in one room by cameras that stood alike."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tangent_train.geometry import TangentGrid
from tangent_train.keypoints import (
    Detector,
    detect_on_equirect,
    detect_on_tangent_images,
    estimate_two_view,
    match,
)
from tests.geometry.directions import angle_deg
from tests.keypoints.scenes import rotation_angle_deg

REAL_DATA = os.environ.get("TANGENT_REAL_DATA")


@pytest.mark.real_data
@pytest.mark.skipif(REAL_DATA is None, reason="TANGENT_REAL_DATA is not set")
@pytest.mark.parametrize("base_level", [None, 1])
def test_one_camera_above_the_other(base_level: int | None) -> None:
    detector, found = Detector(), []
    for name in ("up", "down"):
        path = Path(str(REAL_DATA)) / "panoramas" / f"pair_room_{name}_1024x512.png"
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        grey = image.astype(np.uint8)
        if base_level is None:
            found.append(detect_on_equirect(grey, detector))
        else:
            found.append(detect_on_tangent_images(grey, TangentGrid(base_level, 8), detector))
    up, down = found
    matches = match(up.descriptors, down.descriptors)
    two_view = estimate_two_view(
        up.directions_xyz[matches[:, 0]], down.directions_xyz[matches[:, 1]]
    )
    assert two_view.kind == "general"
    assert two_view.inliers.mean() > 0.85
    assert two_view.rotation is not None
    assert rotation_angle_deg(two_view.rotation, np.eye(3)) < 0.7
    # The upper camera is straight above the lower one.
    assert angle_deg(two_view.translation, [0, 0, 1.0]) < 5  # type: ignore[arg-type]
