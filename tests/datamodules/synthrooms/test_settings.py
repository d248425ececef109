from __future__ import annotations

from typing import Any

import pytest

from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import SettingError


def test_rooms_come_in_the_order_of_the_areas_and_leave_room_for_nothing() -> None:
    settings = RoomSettings(rooms={"5b": 0, "1": 2})
    assert list(settings.as_dict()["rooms"].items()) == [("1", 2), ("5b", 0)]


def test_one_camera_at_least_is_what_it_was_before_it_could_be_said() -> None:
    assert "least_cameras" not in RoomSettings().as_dict()
    assert RoomSettings(least_cameras=2).as_dict()["least_cameras"] == 2


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rooms": {"7": 1}}, r"rooms: found \['7'\]"),
        ({"rooms": {}}, "found no area"),
        ({"rooms": {"1": 0}}, "one room at least"),
        ({"rooms": {"1": -1}}, r"rooms\[1\]: found -1"),
        ({"seed": -1}, "seed"),
        ({"seed": True}, "seed"),
        ({"height": 4}, "height: found 4; expected an integer of 8 or more"),
        ({"height": 64.0}, "height"),
        ({"views": "all"}, "views: found all"),
        ({"views_per_camera": -1}, "views_per_camera"),
        ({"view_size": 0}, "view_size"),
        ({"supersample": 0}, "supersample"),
        ({"least_cameras": 0}, "least_cameras"),
    ],
)
def test_what_cannot_work_is_named(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        RoomSettings(**wrong)
