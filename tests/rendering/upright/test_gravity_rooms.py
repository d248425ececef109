"""The direction of up in furnished rooms, rotated as the test panoramas of a data module are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from datamodules.core.panoramas import Panorama
from datamodules.core.pipeline import RotatedPanoramas
from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.rendering.upright.gravity import estimate_up

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Literal

    from numpy.typing import NDArray


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> list[NDArray[np.uint8]]:
    root: Path = tmp_path_factory.mktemp("rooms")
    settings = RoomSettings(seed=5, rooms={"1": 8}, height=128, supersample=2)
    generate_rooms(root, settings, workers=1)
    paths = sorted(root.glob("area_1/pano/rgb/*.png"))
    return [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in paths]


@pytest.mark.parametrize("rotation", [0.0, 10.0, 35.0, "so3"])
def test_furnished_rooms(rooms: list[NDArray[np.uint8]], rotation: float | Literal["so3"]) -> None:
    rotated = RotatedPanoramas(rotation, seed=2)
    assert len(rooms) >= 8
    for index, rgb in enumerate(rooms):
        panorama = Panorama(rgb, None, np.zeros((128, 256), np.uint8))
        up = rotated.rotation(index)[:, 2]
        gravity = estimate_up(rotated(panorama, index).rgb, 180 if rotation == "so3" else 45)
        # Held at any angle, up may be taken for another axis of the room.
        found = gravity.candidates if rotation == "so3" else gravity.up[None]
        assert (found @ up).max() > math.cos(math.radians(1.5)), index
        assert rotation == "so3" or gravity.confidence > 0.6
