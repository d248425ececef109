"""Levels of panoramas of any size."""

from __future__ import annotations

import math

from tangent_train.errors import SettingError

__all__ = ["nearest_level"]


def nearest_level(height: int) -> int:
    """The level s whose panoramas, of 2^(s+1) rows, are nearest in size.

    Nearest in ratio: 724 rows are nearer to 512 than to 1024, 725 nearer to 1024.

    Args:
        height: Rows of the panorama, 2 or more.

    Raises:
        SettingError: There are fewer rows.

    >>> [nearest_level(rows) for rows in (512, 724, 725, 1024, 2688)]
    [8, 8, 9, 9, 10]
    """
    if height < 2:
        raise SettingError("panorama", found=f"{height} rows", expected="2 or more")
    return max(0, round(math.log2(height)) - 1)
