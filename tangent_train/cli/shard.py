"""Parts of the work of a command, each on a machine of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from tangent_train.errors import SettingError

__all__ = ["Shard"]

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Shard:
    """One of several parts of a list, which differ in length by one item at most.

    Attributes:
        number: 1 to `count`.
        count: Of the parts.
    """

    number: int
    count: int

    @classmethod
    def of(cls, setting: Any) -> Shard | None:
        """The part that a setting names; without one, there are no parts.

        Args:
            setting: As ``3/16``, or None.

        Raises:
            SettingError: There is no such part.

        >>> Shard.of("3/16")
        Shard(number=3, count=16)
        """
        if setting is None:
            return None
        named = re.fullmatch(r"(\d{1,9})/(\d{1,9})", str(setting), re.ASCII)
        number, count = map(int, named.groups()) if named else (0, 0)
        if not 1 <= number <= count:
            raise SettingError("shard", found=setting, expected="1/16 to 16/16, or of others; null")
        return cls(number, count)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, items: Sequence[_Item]) -> list[_Item]:
        """Its items of a list: every `count`-th.

        >>> Shard(2, 3).part("abcdefg")
        ['b', 'e']
        """
        return list(items[self.number - 1 :: self.count])
