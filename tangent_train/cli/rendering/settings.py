"""The settings of ``tangent-render``, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.images.pixel_files import LOSSY_SUFFIXES, PIXEL_SUFFIXES
from datamodules.images.tangent_results import KINDS
from tangent_train.cli import values
from tangent_train.errors import SettingError
from tangent_train.geometry import random_rotation, rotation_about

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from datamodules.images.tangent_results import Kind
    from tangent_train.rendering import Blend, Interpolation

__all__ = ["BackSettings", "ForwardSettings"]

_FORMATS = tuple(suffix[1:] for suffix in PIXEL_SUFFIXES)


@dataclass(frozen=True)
class ForwardSettings:
    """How panoramas become tangent images; see ``configs/render.yaml``."""

    input: str
    output: Path | None
    figure: Path | None
    base_level: int
    level: int | None
    dim: int | None
    faces: tuple[int, ...] | None
    rotation: NDArray[np.float64] | None
    suffix: str
    interpolation: Interpolation
    colmap: bool
    overwrite: bool

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> ForwardSettings:
        """Check the settings.

        Raises:
            SettingError: One cannot work.
        """
        output, figure = values.path(config, "output"), values.path(config, "figure")
        if output is None and figure is None:
            raise SettingError("output", found="none", expected="a folder for the tangent images")
        if figure is not None and figure.suffix.lower() != ".png":
            raise SettingError("figure", found=str(figure), expected="the name of a .png file")
        suffix = "." + values.choice(config, "format", _FORMATS)
        interpolation = values.choice(config, "interpolation", ("bilinear", "nearest"))
        if interpolation == "nearest" and suffix in LOSSY_SUFFIXES:
            raise SettingError(
                "format",
                found=config["format"],
                expected="png, tif or npy with interpolation=nearest: others change pixels",
            )
        base_level = values.whole(config, "base_level", 0)
        level = values.optional_whole(config, "level", base_level)
        return cls(
            input=str(config["input"]),
            output=output,
            figure=figure,
            base_level=base_level,
            level=level,
            dim=values.optional_whole(config, "dim", 2),
            faces=_faces(config["faces"], 20 * 4**base_level),
            rotation=_rotation(config["rotation"], config["seed"]),
            suffix=suffix,
            interpolation=interpolation,
            colmap=values.flag(config, "colmap"),
            overwrite=values.flag(config, "overwrite"),
        )


@dataclass(frozen=True)
class BackSettings:
    """How results become panoramas; see ``configs/render.yaml``."""

    back: Path
    output: Path
    cameras: Path | None
    blend: Blend
    height: int | None
    kind: Kind | Any
    z_depth: bool
    overwrite: bool

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> BackSettings:
        """Check the settings.

        Raises:
            SettingError: One cannot work.
        """
        given = [name for name in ("input", "figure") if config[name] is not None]
        if given:
            raise SettingError(
                "back",
                found=f"{given[0]}= as well",
                expected="one of them: input= renders tangent images, back= what was made of them",
            )
        output = values.path(config, "output")
        if output is None:
            raise SettingError("output", found="none", expected="a file for the panorama")
        return cls(
            back=Path(str(config["back"])).expanduser(),
            output=output,
            cameras=values.path(config, "cameras"),
            blend=values.choice(config, "blend", ("feather", "nearest")),
            height=values.optional_whole(config, "height", 1),
            kind=values.choice(config, "kind", ("auto", *KINDS)),
            z_depth=values.flag(config, "z_depth"),
            overwrite=values.flag(config, "overwrite"),
        )


def _faces(value: Any, count: int) -> tuple[int, ...] | None:
    if value is None:
        return None
    faces = tuple(value) if isinstance(value, list) else (value,)
    known = all(type(face) is int and 0 <= face < count for face in faces)
    if not faces or not known or len(set(faces)) < len(faces):
        expected = f"different indices from 0 to {count - 1}, as in faces=[0,5]"
        raise SettingError("faces", found=value, expected=expected)
    return faces


def _rotation(value: Any, seed: Any) -> NDArray[np.float64] | None:
    """The rotation in the frame of directions: x forward, y to the right, z up."""
    if value is None:
        return None
    if value == "so3":
        if type(seed) is not int or seed < 0:
            raise SettingError("seed", found=seed, expected="a whole number, 0 or more")
        return random_rotation(np.random.default_rng(seed))
    numbers = isinstance(value, list) and [type(angle) in (int, float) for angle in value]
    if numbers != [True] * 3 or not np.isfinite(value).all():
        raise SettingError(
            "rotation",
            found=value,
            expected="[yaw,pitch,roll] in degrees (to the right, up, clockwise), or so3",
        )
    yaw, pitch, roll = np.radians(value)
    # y is to the right here: turning about it the usual way looks down.
    return (
        rotation_about((0, 0, 1), yaw)
        @ rotation_about((0, 1, 0), -pitch)
        @ rotation_about((1, 0, 0), -roll)
    )
