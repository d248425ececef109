"""Settings become what the annotations say, or are refused by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from tangent_train.cli.settings import typed
from tangent_train.errors import SettingError


@dataclass
class _Settings:
    file: Path
    choice: Literal["a", "b"] | None
    share: float
    count: int | None
    names: tuple[str, ...]
    pair: tuple[int, int] | None
    flag: bool


GIVEN: dict[str, Any] = {
    "file": "~/x", "choice": None, "share": 1, "count": 3,
    "names": "one", "pair": [1, 2], "flag": True, "other": 5,
}  # fmt: skip


def test_values_are_converted() -> None:
    expected = _Settings(Path.home() / "x", None, 1.0, 3, ("one",), (1, 2), True)
    assert typed(_Settings, GIVEN) == expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": None}, "file: found none; expected a file or folder"),
        ({"choice": "c"}, "choice: found c; expected a or b or null"),
        ({"share": float("nan")}, "share: found nan; expected a number"),
        ({"count": True}, "count: found True; expected a whole number or null"),
        ({"pair": [1, 2, 3]}, "pair: found"),
        ({"flag": "no"}, "flag: found no; expected true or false"),
    ],
)
def test_others_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=f"^{message}"):
        typed(_Settings, GIVEN | changes)
