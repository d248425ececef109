"""The studies of ``tangent-study``: what they are called, their settings, how they are run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tangent_train.cli import values
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from studies.outcome import Outcome

__all__ = ["STUDIES", "Settings", "Study"]

Settings = Mapping[str, Any]
Say = Callable[[str], None]


@dataclass(frozen=True)
class Study:
    """A study as the command line knows it.

    Attributes:
        about: One line.
        settings: Default and one line, by name.
        check: Settings as they are typed to those of `run`, with errors before any work.
        run: Is given the checked settings, and what to call with words on what goes on.
    """

    about: str
    settings: Mapping[str, tuple[Any, str]]
    check: Callable[[Settings], Settings]
    run: Callable[[Settings, Say], Outcome]


def _surface_area(settings: Settings, _say: Say) -> Outcome:
    from studies.surface_area import surface_area

    return surface_area(settings["levels"])


def _angular_resolution(settings: Settings, _say: Say) -> Outcome:
    from studies.angular_resolution import angular_resolution

    return angular_resolution(settings["levels"])


def _fov(settings: Settings, _say: Say) -> Outcome:
    from studies.fov import fov

    return fov(settings["level"])


def _distorted_digits(settings: Settings, say: Say) -> Outcome:
    from studies.distorted_digits import distorted_digits

    return distorted_digits(**settings, say=say)


def _representation_distortion(settings: Settings, _say: Say) -> Outcome:
    from studies.representation_distortion import representation_distortion

    return representation_distortion(settings["side"])


def _check_levels(settings: Settings) -> Settings:
    return {"levels": _between(settings, "levels", 0, 12)}


def _check_level(settings: Settings) -> Settings:
    return {"level": _between(settings, "level", 4, 16)}


def _check_digits(settings: Settings) -> Settings:
    from importlib.util import find_spec

    mnist = values.path(settings, "mnist")
    if mnist is not None:
        from studies.digits import find_mnist

        find_mnist(mnist)
    elif find_spec("sklearn") is None:
        raise SettingError(
            "distorted_digits",
            found="no scikit-learn",
            expected="the package that brings the digits, or mnist=<folder>",
            remedy="Run: pip install 'tangent-train[study]'",
        )
    seeds = settings["seeds"]
    whole = isinstance(seeds, list) and all(
        type(seed) is int and 0 <= seed < 2**32 for seed in seeds
    )
    if not whole or not seeds or len(set(seeds)) < len(seeds):
        expected = "different whole numbers, 0 or more, as in [0,1,2]"
        raise SettingError("seeds", found=seeds, expected=expected)
    return {"mnist": mnist, "seeds": seeds, "epochs": values.optional_whole(settings, "epochs", 1)}


def _check_side(settings: Settings) -> Settings:
    side = _between(settings, "side", 16, 512)
    if side & (side - 1):
        raise SettingError("side", found=side, expected="a power of 2 from 16 to 512")
    return {"side": side}


def _between(settings: Settings, name: str, least: int, most: int) -> int:
    value = values.whole(settings, name, least)
    if value > most:
        raise SettingError(name, found=value, expected=f"{most} or less")
    return value


STUDIES: Mapping[str, Study] = {
    "surface_area": Study(
        "area of the subdivided icosahedron over that of the sphere",
        {"levels": (10, "the last level of subdivision, 0 to 12 (12 takes 3 GB)")},
        _check_levels,
        _surface_area,
    ),
    "angular_resolution": Study(
        "levels, sizes of panoramas and degrees per pixel, beside perspective cameras",
        {"levels": (10, "the last level of subdivision, 0 to 12 (12 takes 3 GB)")},
        _check_levels,
        _angular_resolution,
    ),
    "fov": Study(
        "fields of view of tangent images at base levels 0 to 4",
        {"level": (10, "level of the panorama, 4 to 16")},
        _check_level,
        _fov,
    ),
    "distorted_digits": Study(
        "accuracy of a classifier on digits seen through a lens with K1 from 0 to 0.5",
        {
            "mnist": (None, "folder of MNIST, which is not downloaded; scikit-learn's digits else"),
            "seeds": ([0, 1, 2], "one network is trained for each"),
            "epochs": (None, "of the training: 2 of MNIST, 30 of scikit-learn's, unless given"),
        },
        _check_digits,
        _distorted_digits,
    ),
    "representation_distortion": Study(
        "distortion of angles and areas by ERP, cube map and tangent images",
        {"side": (128, "pixels of the images that are measured, a power of 2, 16 to 512")},
        _check_side,
        _representation_distortion,
    ),
}
"""All studies by name."""
