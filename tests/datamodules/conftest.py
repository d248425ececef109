from __future__ import annotations

from pathlib import Path

import pytest

from datamodules.synthrooms.datamodule import RoomSettings, generate_rooms
from datamodules.synthshapes import ShapeSettings, generate_shapes
from tangent_train.rendering import EquirectRepresentation

TINY_ROOMS = RoomSettings(
    seed=3,
    rooms={"1": 2, "5a": 1, "5b": 1},
    height=16,
    views_per_camera=1,
    view_size=8,
    supersample=1,
)
TINY_SHAPES = ShapeSettings(seed=3, train=2, test=1)


@pytest.fixture
def erp() -> EquirectRepresentation:
    """Crops of 16×8 pixels in training, panoramas in evaluation; nothing is interpolated."""
    return EquirectRepresentation(level=3, crop_deg=90)


@pytest.fixture(scope="session")
def tiny_rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rooms of `TINY_ROOMS`; not to be changed."""
    root = tmp_path_factory.mktemp("data") / "rooms"
    generate_rooms(root, TINY_ROOMS, workers=0)
    return root


@pytest.fixture(scope="session")
def tiny_shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shapes of `TINY_SHAPES`; not to be changed."""
    root = tmp_path_factory.mktemp("data") / "shapes"
    generate_shapes(root, TINY_SHAPES)
    return root
