"""A photo network from another library or file, and the names of its scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from torch import nn

from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.kinds import DepthKind, ScoreKind
from tangent_train.errors import DataError, SettingError
from tangent_train.files import read_json

USUAL_SIZE = (512, 512)
"""Rows and columns of the photos if they are unknown."""


@dataclass(frozen=True)
class PhotoNetwork:
    """A trained network for photos.

    Attributes:
        module: Maps normalized RGB images ``(B, 3, h, w)`` to scores ``(B, K, h, w)``, to a dict
            that contains them under ``"out"``, to label maps ``(B, h, w)``,
            or to depth ``(B, 1, h, w)`` or ``(B, h, w)``; see also `declared_sizes`.
        settings: Section of a config that builds the network; None for an ONNX file.
        score_names: Name of each score; none for depth.
        normalization: Normalization of the images.
        image_size: Rows and columns of the training images.
        score_kind: Kind of the network's output if its library declares it, see `usual_kind`.
        depth_kind: Kind of depth that the network predicts; None for classes.
    """

    module: nn.Module
    settings: dict[str, Any] | None
    score_names: Sequence[str]
    normalization: Normalization
    image_size: tuple[int, int] = USUAL_SIZE
    score_kind: ScoreKind | None = None
    depth_kind: DepthKind | None = None


def class_names_in(path: Path | None, depth: DepthKind | None = None) -> tuple[str, ...]:
    """Read the names of a network's scores, in their order; return none for a depth network.

    Args:
        path: JSON file with a list of names, or an object that maps each index to a name, such as
            ``{"0": "wall"}`` (``id2label``).
        depth: Kind of depth; None for a network that predicts classes.

    Raises:
        SettingError: No file is given.
        DataError: The file has other content.
    """
    if depth is not None:
        return ()
    expected = 'a JSON list of class names in the order of the scores, ["wall", "floor"]'
    if path is None:
        raise SettingError(
            "classes",
            found="none",
            expected=f"a file with {expected}",
            remedy=f"For a depth network, set depth= to one of {', '.join(get_args(DepthKind))}.",
        )
    return names_of(read_json(path, expected), path, expected)


def names_of(content: Any, path: Path, expected: str) -> tuple[str, ...]:
    """Return names from the content of a file, see `class_names_in`.

    Args:
        content: A list of names, or a dict that maps each index to a name.
        path: File of the names, for the message.
        expected: Expected content, for the message.

    Raises:
        DataError: The content is neither.
    """
    names = content if isinstance(content, list) else []
    if isinstance(content, dict):
        names = [content.get(str(index)) for index in range(len(content))]
    if not names or not all(isinstance(name, str) and name for name in names):
        raise DataError(path, found=str(content)[:80], expected=expected)
    return tuple(names)
