from __future__ import annotations

from typing import Any

import pytest

from datamodules.synthrooms.settings import RoomSettings
from tangent_train.errors import SettingError


def test_rooms_come_in_the_order_of_the_areas() -> None:
    settings = RoomSettings(rooms={"area_5b": 0, "1": 2})
    assert list(settings.rooms.items()) == [("1", 2), ("5b", 0)]
    assert settings.areas == ["1"]
    assert sum(RoomSettings().rooms.values()) == 232


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rooms": {"7": 1}}, "rooms: found"),
        ({"rooms": {"1": 0}}, "rooms: found"),
        ({"rooms": {"1": -1}}, r"rooms\[1\]: found -1"),
        ({"seed": True}, "seed"),
        ({"height": 7}, "height: found 7; expected an integer of 8 or more"),
        ({"views": "all"}, "views: found all"),
    ],
)
def test_what_cannot_work_is_named(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        RoomSettings(**wrong)
