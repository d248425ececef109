"""A photo network from another library, the names of its scores, and its saved files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from torch import Tensor, nn

from datamodules.core.inputs import Normalization
from models.pretrained import read_tensors
from tangent_train.errors import DataError, first_line
from tangent_train.files import read_json
from tangent_train.kinds import DepthKind, ScoreKind

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
        things: Names of the scores of which the network also returns objects, see `Segments`.
        unknown: Names of scores that are not classes.
    """

    module: nn.Module
    settings: dict[str, Any] | None
    score_names: Sequence[str]
    normalization: Normalization
    image_size: tuple[int, int] = USUAL_SIZE
    score_kind: ScoreKind | None = None
    depth_kind: DepthKind | None = None
    things: Sequence[str] = ()
    unknown: Sequence[str] = ()


_WEIGHTS = "model.safetensors"
_SHARDS = "model-*-of-*.safetensors"
_FILES = ("*.json", _WEIGHTS, _SHARDS, "merges.txt")


def class_names_in(path: Path | None, depth: DepthKind | None = None) -> tuple[str, ...]:
    """Read the names of a network's scores, in their order; return none for a depth network.

    Args:
        path: JSON file with a list of names, or an object that maps each index to a name, such as
            ``{"0": "wall"}`` (``id2label``).
        depth: Kind of depth; None for a network that predicts classes.

    Raises:
        DataError: The file is missing, or has other content.
    """
    if depth is not None:
        return ()
    expected = 'a JSON list of class names in the order of the scores, ["wall", "floor"]'
    content = None if path is None else read_json(path, expected)
    return names_of(content, path or "classes", expected)


def names_of(content: Any, source: object, expected: str) -> tuple[str, ...]:
    """Return names from the content of a file, see `class_names_in`.

    Args:
        content: A list of names, or a dict that maps each index to a name.
        source: File of the names or setting, for the message.
        expected: Expected content, for the message.

    Raises:
        DataError: The content is neither.
    """
    names = content if isinstance(content, list) else []
    if isinstance(content, dict):
        names = [content.get(str(index)) for index in range(len(content))]
    if not names or not all(isinstance(name, str) and name for name in names):
        kinds = f"For a depth network, set depth= to one of {', '.join(get_args(DepthKind))}."
        raise DataError(source, found=str(content or "none")[:80], expected=expected, remedy=kinds)
    return tuple(names)


def saved_folder(model: str | Path | None) -> Path:
    """Return the folder of a saved model, which is fetched from the hub if necessary.

    Args:
        model: A folder written by ``save_pretrained`` of transformers or of
            segmentation-models-pytorch, or a name on the hub, ``owner/name``.

    Raises:
        DataError: The model is neither a folder nor can it be fetched.
    """
    name = str(model)
    if Path(name).is_dir():
        return Path(name)
    try:
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(name, allow_patterns=list(_FILES)))
    except Exception as error:  # no connection, no such name, or the model needs a login
        fetch = f"hf download {name} --local-dir {name.rpartition('/')[2] or 'network'}"
        raise DataError(
            name,
            found="no such folder, and no way to fetch it "
            f"({type(error).__name__}: {first_line(error)})",
            expected="a folder, or the name of a model on huggingface.co that you may read",
            remedy=f"On a machine with access, run `{fetch}` (after `hf auth login` if the model "
            "requires agreement to terms), and set model= to the path of that folder.",
        ) from error


def tensors_in(folder: Path) -> dict[str, Tensor]:
    """Read the weights of a saved model by name, floats as float32.

    Args:
        folder: Folder of the model.

    Raises:
        DataError: There are no safetensors files, or they are unreadable.
    """
    whole = folder / _WEIGHTS
    paths = [whole] if whole.is_file() else sorted(folder.glob(_SHARDS))
    if not paths:
        raise DataError(
            folder,
            found=f"no {_WEIGHTS}",
            expected="weights as safetensors: reading other formats may run code",
            remedy="If you trust the files, load them with from_pretrained(…) of their library and "
            "write them with save_pretrained(…), which creates safetensors.",
        )
    tensors = {name: t for path in paths for name, t in read_tensors(path)[""].items()}
    return {n: t.float() if t.is_floating_point() else t for n, t in tensors.items()}
