"""Settings become what the annotations say, or are refused by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tangent_train.cli.settings import typed


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
