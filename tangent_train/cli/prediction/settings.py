"""What the command line of tangent-predict asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tangent_train.cli import values
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from datamodules.core.panorama_module import Upright
    from tangent_train.inference.predictor import Level
    from tangent_train.rendering import Blend

__all__ = ["PredictSettings"]

_CROP = "[west,east,south,north] in degrees, or null"


@dataclass(frozen=True)
class PredictSettings:
    """What the command line asks for, checked; see ``predict.yaml``."""

    checkpoint: Path
    input: str
    output: Path
    depth: Path | None
    depth_scale: float
    projection: str
    crop: list[float] | None
    fov: float | None
    level: Level
    base_level: int | None
    blend: Blend
    rotations: int
    upright: Upright
    max_tilt_deg: float
    probabilities: bool
    report: int
    overwrite: bool
    resume: bool
    images_per_forward: int | None
    device: str
    trust: tuple[str, ...]

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> PredictSettings:
        """Check them.

        Raises:
            SettingError: One is missing or cannot work.
        """
        _check_given(config)
        projection = values.choice(config, "projection", ("equirectangular", "perspective"))
        other = "panoramas" if projection == "perspective" else "photos"
        for name in ("crop", "rotations", "upright") if projection == "perspective" else ("fov",):
            if config[name] not in (None, 1):
                remedy = "" if other == "panoramas" else "Add projection=perspective."
                raise SettingError(
                    name,
                    found=config[name],
                    expected=f"none with projection={projection}: it is for {other}",
                    remedy=remedy,
                )
        depth = values.path(config, "depth")
        if depth is not None and not depth.is_dir():
            raise SettingError("depth", found=str(depth), expected="a folder of depth images")
        image_level = config["level"] == "image"
        return cls(
            checkpoint=Path(str(config["checkpoint"])).expanduser(),
            input=str(config["input"]),
            output=Path(str(config["output"])).expanduser(),
            depth=depth,
            depth_scale=values.number(config, "depth_scale", 0, math.inf),
            projection=projection,
            crop=values.numbers(config, "crop", _CROP),
            fov=None if config["fov"] is None else values.number(config, "fov", 0, 180),
            level="image" if image_level else values.optional_whole(config, "level", 0),
            base_level=values.optional_whole(config, "base_level", 0),
            blend=values.choice(config, "blend", ("feather", "nearest")),
            rotations=values.whole(config, "rotations", 1),
            upright=None
            if config["upright"] is None
            else values.choice(config, "upright", ("pose", "auto")),
            max_tilt_deg=values.number(config, "max_tilt_deg", 0, 180),
            probabilities=values.flag(config, "probabilities"),
            report=values.whole(config, "report", 0),
            overwrite=values.flag(config, "overwrite"),
            resume=values.flag(config, "resume"),
            images_per_forward=values.optional_whole(config, "images_per_forward", 1),
            device=str(config["device"]),
            trust=values.names(config, "trust"),
        )


def _check_given(config: Mapping[str, Any]) -> None:
    examples = {"checkpoint": "runs/…/best.ckpt", "input": "panoramas", "output": "labels"}
    for name, example in examples.items():
        if config[name] is None:
            raise SettingError(
                name,
                found="none",
                expected="a file" if name == "checkpoint" else "a file or folder",
                remedy=f"For example: tangent-predict {name}={example} …",
            )
