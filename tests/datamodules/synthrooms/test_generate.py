from __future__ import annotations

from pathlib import Path

from datamodules import SynthRoomsPerspective
from datamodules.core.found import SPLITS
from datamodules.synthrooms.generate import plan_rooms
from datamodules.synthrooms.settings import RoomSettings
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.conftest import TINY_ROOMS
from tests.datamodules.data_files import names_of


def test_rooms_have_as_many_cameras_as_wanted_and_are_the_same_rooms() -> None:
    usual = plan_rooms(RoomSettings(rooms={"1": 50}))
    more = plan_rooms(RoomSettings(rooms={"1": 50}, least_cameras=2))
    for one, other in zip(usual, more, strict=True):
        assert (one.name, one.area) == (other.name, other.area)
        assert len(other.cameras) == max(2, len(one.cameras))
        assert other.cameras[: len(one.cameras)] == one.cameras


def test_views_are_read_like_photos_of_the_real_set(tiny_rooms: Path) -> None:
    crops = PerspectiveRepresentation(level=5, fov_deg=20)
    module = SynthRoomsPerspective(tiny_rooms, crops, rooms=vars(TINY_ROOMS))
    module.prepare_data()
    names = [name for split in SPLITS for name in names_of(module, split)]
    assert len(set(names)) == len(names) == sum(len(p.cameras) for p in plan_rooms(TINY_ROOMS))
    photo = module.source("test").read(0)
    assert photo.rgb.shape == (8, 8, 3)
    assert photo.labels.max() > 0
