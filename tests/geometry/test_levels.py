"""Levels of panoramas."""

from __future__ import annotations

import math

import pytest

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_shape, nearest_level


@pytest.mark.parametrize("level", [0, 1, 7, 13])
def test_the_level_s_own_rows(level: int) -> None:
    rows, _ = equirect_shape(level)
    assert nearest_level(rows) == level
    assert nearest_level(math.floor(rows * math.sqrt(2))) == level
    assert nearest_level(math.ceil(rows * math.sqrt(2))) == level + 1


def test_too_few_rows() -> None:
    with pytest.raises(SettingError, match="1 rows"):
        nearest_level(1)
