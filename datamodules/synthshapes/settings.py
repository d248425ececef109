"""What a SynthShapes data set consists of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from tangent_train.errors import SettingError

__all__ = ["ShapeSettings"]


@dataclass(frozen=True)
class ShapeSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything, 0 or more.
        train: Shapes of every class for training (and validation).
        test: Shapes of every class for the test.

    Raises:
        SettingError: A setting that cannot work.
    """

    seed: int = 0
    train: int = 80
    test: int = 30

    def __post_init__(self) -> None:
        for name, least in {"seed": 0, "train": 1, "test": 1}.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise SettingError(
                    f"data.shapes.{name}",
                    found=repr(value),
                    expected=f"an integer of {least} or more",
                )

    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for JSON."""
        return asdict(self)
