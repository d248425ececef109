"""The command line of tangent-keypoints, before Hydra reads it."""

from __future__ import annotations

import re

__all__ = ["keypoint_arguments"]

_LIST = re.compile(r"base_level=(\d+(?:,\d+)+)")
_OF_IMAGES = ("left=", "right=", "input=")


def keypoint_arguments(arguments: list[str]) -> list[str]:
    """Say in Hydra's words what is plain: a list of base levels, and that images are the data.

    Args:
        arguments: The command line after the program's name.

    >>> keypoint_arguments(["base_level=0,1", "left=a.jpg", "right=b.jpg"])
    ['data=image_pairs', 'base_level=[0,1]', 'left=a.jpg', 'right=b.jpg']
    """
    if not {"-m", "--multirun"} & set(arguments):
        arguments = [
            _LIST.sub(r"base_level=[\1]", a) if _LIST.fullmatch(a) else a for a in arguments
        ]
    chosen = any(argument.startswith("data=") for argument in arguments)
    places = [k for k, argument in enumerate(arguments) if "=" in argument and argument[0] != "-"]
    if chosen or not any(argument.startswith(_OF_IMAGES) for argument in arguments):
        return arguments
    # Beside another override: argparse wants all of them in one place.
    return [*arguments[: places[0]], "data=image_pairs", *arguments[places[0] :]]
