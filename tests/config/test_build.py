"""Objects of the user's config: all conventions of Hydra, and errors in one line."""

from __future__ import annotations

from typing import Any

import pytest

from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError

ME = __name__
UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 13, "widths": [4, 8]}


ADAM = {"_target_": "torch.optim.Adam", "_partial_": True}


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


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (UNET | {"in_chanels": 3}, r"^network: found models\.UNet.*argument 'in_chanels'"),
        ({"_target_": f"{ME}.Kept", "i": UNET | {"x": 1}}, r"^network: .*argument 'x'"),
        ({"_target_": f"{ME}.Handing", "x": 1}, r"^network: .*Handing.* argument 'x'"),
        (
            {"_target_": "lightning.Trainer", "max_epochs": "abc"},
            "max_epochs: found abc; .*integer",
        ),
        ({**ADAM, "betas": 5}, r"^network\.betas: found 5; expected a valid tuple"),
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
