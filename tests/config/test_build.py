"""Objects of the user's config: all conventions of Hydra, and errors in one line."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
from omegaconf import DictConfig

from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError

ME = __name__
UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 13, "widths": [4, 8]}


class Kept:
    """Keeps its arguments."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        self.positional, self.named = positional, named


class Handing(Kept):
    """Hands its arguments on to a function that does not have all of them."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(pair(1, **settings))


def pair(first: Any, second: Any = None) -> tuple[Any, Any]:
    """Return both arguments."""
    return first, second


def test_conventions_of_hydra() -> None:
    inner = {"_target_": f"{ME}.pair", "first": 1}
    kept = build_from_config({"_target_": f"{ME}.Kept", "_args_": [1, inner], "x": [inner]}, "x")
    assert kept.positional == (1, (1, None))
    assert kept.named == {"x": [(1, None)]}
    left = {"_target_": f"{ME}.Kept", "_recursive_": False, "x": inner}
    assert build_from_config(left, "x").named == {"x": inner}
    for convert, kind in ((None, dict), ("all", dict), ("none", DictConfig)):
        section = {"_target_": f"{ME}.Kept", "x": {"y": [1]}} | (
            {} if convert is None else {"_convert_": convert}
        )
        assert type(build_from_config(section, "x").named["x"]) is kind
    later = build_from_config({"_target_": f"{ME}.pair", "_partial_": True, "first": 1}, "x")
    assert type(later) is partial
    assert (later.func, later.keywords, later(second=2)) == (pair, {"first": 1}, (1, 2))
    given = build_from_config({"_target_": f"{ME}.pair", "first": 1}, "x", first=inner, second=2)
    assert given == (inner, 2), "handed on as they are"


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (UNET | {"in_chanels": 3}, r"^network: found models\.UNet.*argument 'in_chanels'"),
        ({"_target_": f"{ME}.Kept", "i": UNET | {"x": 1}}, r"^network: .*argument 'x'"),
        ({"_target_": f"{ME}.Absent"}, r"^network: found .*Absent"),
        ({"_target_": f"{ME}.Handing", "x": 1}, r"^network: .*Handing.* argument 'x'"),
        (None, r"^network: found None; expected a section"),
    ],
)
def test_errors_in_one_line(section: Any, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        build_from_config(section, "network")


def test_errors_of_ones_own_class_are_raised_as_they_are() -> None:
    section = {"_target_": "builtins.int", "_args_": ["x"]}
    for tried in (section, {"_target_": f"{ME}.Kept", "x": section}):
        with pytest.raises(ValueError, match="invalid literal"):
            build_from_config(tried, "x")
