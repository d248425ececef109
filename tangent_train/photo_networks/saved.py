"""Read folders written by ``save_pretrained`` of transformers or segmentation-models-pytorch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from models.pretrained import read_tensors
from tangent_train.errors import DataError, SettingError, first_line
from tangent_train.files import read_json

_WEIGHTS = "model.safetensors"
_SHARDS = "model-*-of-*.safetensors"
_FILES = ("*.json", _WEIGHTS, _SHARDS, "merges.txt")


def saved_folder(model: str | None) -> Path:
    """Return the folder of a model, which is fetched from the hub if necessary.

    Args:
        model: A folder, or a name on the hub, ``owner/name``.

    Raises:
        DataError: The model is neither a folder nor can it be fetched.
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
    except Exception as error:  # no connection, no such name, or the model needs a login
        fetch = f"hf download {model} --local-dir {model.rpartition('/')[2] or 'network'}"
        raise DataError(
            model,
            found="no such folder, and no way to fetch it "
            f"({type(error).__name__}: {first_line(error)})",
            expected="a folder, or the name of a model on huggingface.co that you may read",
            remedy=f"On a machine with access, run `{fetch}` (after `hf auth login` if the model "
            "requires agreement to terms), and set model= to the path of that folder.",
        ) from error


def json_in(folder: Path, name: str) -> dict[str, Any]:
    """Read the object in a JSON file of a saved model.

    Args:
        folder: Folder of the model.
        name: Name of the file.

    Raises:
        DataError: The file is missing or has other content.
    """
    path, expected = folder / name, "a JSON object of save_pretrained"
    content = read_json(path, expected)
    if not isinstance(content, dict):
        raise DataError(path, found=type(content).__name__, expected=expected)
    return content


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
