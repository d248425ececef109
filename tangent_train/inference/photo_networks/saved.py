"""Folders that ``save_pretrained`` of transformers or segmentation-models-pytorch wrote."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models.pretrained import read_tensors
from tangent_train.errors import DataError, SettingError, first_line
from tangent_train.files import read_json

_WEIGHTS = "model.safetensors"
_SHARDS = "model-*-of-*.safetensors"
_FILES = ("*.json", _WEIGHTS, _SHARDS, "merges.txt")


def saved_folder(model: str | None) -> Path:
    """The folder of a model: the user's own, or of files fetched from the hub.

    Args:
        model: A folder, or a name on the hub, ``owner/name``.

    Raises:
        DataError: It can be neither found nor fetched.
        SettingError: No model is given.
    """
    if model is None:
        raise SettingError("model", found="none", expected="a name on the hub, or a folder")
    folder = Path(model)
    if folder.is_dir():
        return folder
    try:
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(model, allow_patterns=list(_FILES)))
    except Exception as error:  # no connection, no such name, or one must sign in for it
        fetch = f"hf download {model} --local-dir {model.rpartition('/')[2] or 'network'}"
        raise DataError(
            model,
            found="no such folder, and no way to fetch it "
            f"({type(error).__name__}: {first_line(error)})",
            expected="a folder, or the name of a model on huggingface.co that you may read",
            remedy=f"On a machine that can, run `{fetch}` (first `hf auth login` if its page asks "
            "you to agree to terms), and set model= to the path of that folder.",
        ) from error


def json_in(folder: Path, name: str) -> dict[str, Any]:
    """The object in a JSON file of such a folder.

    Raises:
        DataError: It is missing or holds something else.
    """
    path, expected = folder / name, "a JSON object of save_pretrained"
    content = read_json(path, expected)
    if not isinstance(content, dict):
        raise DataError(path, found=type(content).__name__, expected=expected)
    return content


def tensors_in(folder: Path) -> tuple[dict[str, Tensor], Sequence[str]]:
    """The weights of such a folder as float32, and remarks about them.

    Raises:
        DataError: There are none as safetensors, or they are unreadable.
    """
    whole = folder / _WEIGHTS
    paths = [whole] if whole.is_file() else sorted(folder.glob(_SHARDS))
    if not paths:
        others = [path.name for path in sorted(folder.glob("*.bin"))]
        raise DataError(
            folder,
            found=f"{', '.join(others) or 'no weights'}, no {_WEIGHTS}",
            expected="weights as safetensors: reading others may run code",
            remedy="Where you trust them, load them with from_pretrained(…) of their library and "
            "write them with save_pretrained(…), which makes safetensors.",
        )
    tensors = {name: t for path in paths for name, t in read_tensors(path)[""].items()}
    floats = {name: t for name, t in tensors.items() if t.is_floating_point()}
    kinds = sorted({str(t.dtype).removeprefix("torch.") for t in floats.values()} - {"float32"})
    remarks = [f"weights as {', '.join(kinds)} are stored as float32"] if kinds else []
    return tensors | {name: t.to(torch.float32) for name, t in floats.items()}, remarks
