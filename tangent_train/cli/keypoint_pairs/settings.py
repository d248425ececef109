"""What the command line of tangent-keypoints asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tangent_train.cli import values
from tangent_train.errors import SettingError
from tangent_train.results.keypoints.representations import LEAST_STEPS

__all__ = ["EXPORTS", "KeypointSettings"]

EXPORTS = ("none", "colmap_text", "colmap_database")
_DETECTORS = ("sift", "orb", "akaze")
_MOST_DEG = math.nextafter(20, 21)
_DECIDING = (
    "data",
    "base_level",
    "level",
    "detector",
    "margin",
    "ratio",
    "mutual",
    "max_error_deg",
    "seed",
    "controls",
)
"""Settings that figures depend on."""


@dataclass(frozen=True)
class KeypointSettings:
    """What the command line asks for, checked; see ``keypoints.yaml``."""

    output: Path
    overwrite: bool
    base_levels: tuple[int, ...]
    level: int | None
    detector: str
    margin: int
    ratio: float
    mutual: bool
    max_error_deg: float
    seed: int
    controls: bool
    max_pairs: int | None
    pictures: int
    export: str
    deciding: dict[str, Any]

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> KeypointSettings:
        """Check them.

        Raises:
            SettingError: One is missing or cannot work.
        """
        output = values.path(config, "output")
        if output is None:
            raise SettingError(
                "output",
                found="none",
                expected="a folder for the results",
                remedy="For example: tangent-keypoints output=keypoints …",
            )
        base_levels = _base_levels(config["base_level"])
        detector = values.choice(config, "detector", _DETECTORS)
        export = values.choice(config, "export", EXPORTS)
        if export == "colmap_text" and detector != "sift":
            raise SettingError(
                "export",
                found=f"colmap_text with detector={detector}",
                expected="SIFT's descriptors, the only ones that COLMAP's text has",
                remedy="Choose export=colmap_database.",
            )
        deciding = {name: config[name] for name in _DECIDING}
        return cls(
            output=output,
            overwrite=values.flag(config, "overwrite"),
            base_levels=base_levels,
            level=values.optional_whole(config, "level", max(base_levels) + LEAST_STEPS),
            detector=detector,
            margin=values.whole(config, "margin", 0),
            ratio=_ratio(config),
            mutual=values.flag(config, "mutual"),
            max_error_deg=values.number(config, "max_error_deg", 0, _MOST_DEG),
            seed=values.whole(config, "seed", 0),
            controls=values.flag(config, "controls"),
            max_pairs=values.optional_whole(config, "max_pairs", 1),
            pictures=values.whole(config, "pictures", 0),
            export=export,
            deciding=deciding | {"base_level": list(base_levels)},
        )

    @property
    def told(self) -> str:
        """The settings in a sentence, for the reader of the tables."""
        level = "from the rows of each pair" if self.level is None else str(self.level)
        mutual = ", mutual" if self.mutual else ""
        return (
            f"Detector {self.detector}, level {level}, margin {self.margin}, ratio {self.ratio:g}"
            f"{mutual}, inliers within {self.max_error_deg:g}°, seed {self.seed}."
        )


def _ratio(config: Mapping[str, Any]) -> float:
    ratio = values.number(config, "ratio", 0, math.inf)
    if ratio > 1:
        raise SettingError(
            "ratio", found=config["ratio"], expected="at most 1, which keeps every nearest match"
        )
    return ratio


def _base_levels(value: Any) -> tuple[int, ...]:
    levels = tuple(value) if isinstance(value, list) else (value,)
    whole = all(type(level) is int and level >= 0 for level in levels)
    if not levels or not whole or len(set(levels)) < len(levels):
        raise SettingError(
            "base_level", found=value, expected="different whole numbers, 0 or more: base_level=0,1"
        )
    return tuple(sorted(levels))
