"""Exported networks: what is written beside the numbers, and reading them again."""

from __future__ import annotations

import json
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import nn

from datamodules.samples import Input, Normalization
from models.onnx_network import OnnxNetwork
from tangent_train.errors import DataError
from tangent_train.tasks.networks import TrainedNetwork, network_from

__all__ = [
    "METADATA_KEY",
    "is_torchscript",
    "load_onnx",
    "load_safetensors",
    "load_torchscript",
    "metadata_json",
    "torchscript_without_warnings",
]

METADATA_KEY = "tangent_train"
"""Names the JSON text: in an ONNX file's ``metadata_props``, in safetensors' ``__metadata__``, and
as an extra file of a TorchScript archive."""

_jit: Any = torch.jit  # partly without types
_EXPECTED = "a network written by tangent-export"
_VERSION = "tangent_train_version"
_DESCRIBED = tuple(field.name for field in fields(TrainedNetwork) if field.name != "network")


def metadata_json(trained: TrainedNetwork) -> str:
    """All that is known of a network besides its numbers, as JSON.

    The fields of `TrainedNetwork`, but ``network``, under their names; ``normalization`` with
    ``mean`` and ``std``; ``tangent_train_version``.
    """
    content = {name: getattr(trained, name) for name in _DESCRIBED}
    normalization = trained.normalization
    content["normalization"] = {"mean": normalization.mean, "std": normalization.std}
    content[_VERSION] = version("tangent-train")
    return json.dumps(content)


def load_onnx(path: Path) -> TrainedNetwork:
    """Read an ONNX file; onnxruntime computes.

    Raises:
        DataError: It is none, or none of ours, or onnxruntime is missing.
    """
    network = OnnxNetwork(path)
    return _trained(path, network.metadata.get(METADATA_KEY), network)


def load_torchscript(path: Path) -> TrainedNetwork:
    """Read a TorchScript archive, on the CPU.

    Raises:
        DataError: It is none, or none of ours.
    """
    extra: dict[str, Any] = {METADATA_KEY: ""}
    try:
        with torchscript_without_warnings():
            network: nn.Module = _jit.load(path, map_location="cpu", _extra_files=extra)
    except (RuntimeError, ValueError) as error:
        raise _unreadable(path, error) from error
    text = extra[METADATA_KEY]
    return _trained(path, text.decode() if isinstance(text, bytes) else text, network)


def load_safetensors(path: Path) -> TrainedNetwork:
    """Read tensors, and make the network they belong to.

    Raises:
        DataError: It is no such file, or none of ours, its network cannot be made, or the package
            safetensors is missing.
    """
    with _safetensors(path) as file:
        text = (file.metadata() or {}).get(METADATA_KEY)
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    content = _content(path, text)
    if not content["settings"]:
        raise DataError(path, found="no settings of the network inside", expected=_EXPECTED)
    network = network_from(path, content["settings"], tensors)
    return _trained(path, text, network)


def safetensors_inputs(path: Path) -> tuple[Input, ...]:
    """What the network of a file is shown.

    Raises:
        DataError: See `load_safetensors`.
    """
    with _safetensors(path) as file:
        text = (file.metadata() or {}).get(METADATA_KEY)
    return tuple(_content(path, text)["inputs"])


@contextmanager
def _safetensors(path: Path) -> Iterator[Any]:
    """An open file.

    Raises:
        DataError: It is no such file, or the package safetensors is missing.
    """
    if not path.is_file():
        raise DataError(path, found="no such file", expected=_EXPECTED)
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise DataError(
            path,
            found="a safetensors file",
            expected="the package safetensors, to read it",
            remedy="Run: pip install 'tangent-train[export]'",
        ) from error
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except (SafetensorError, OSError) as error:
        raise _unreadable(path, error) from error


def is_torchscript(path: Path) -> bool:
    """Whether a file is a TorchScript archive; checkpoints are zip files too."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


@contextmanager
def torchscript_without_warnings() -> Iterator[None]:
    """Leave out what torch says about TorchScript itself.

    torch ≥ 2.14 deprecates it for torch.export, whose archives are bound to one version of torch:
    nothing for those who want one file for other programs. That branches on sizes are kept as they
    were seen (`TracerWarning`) is checked by running the result with other sizes.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit\.\w+` is deprecated", FutureWarning)
        warnings.filterwarnings("ignore", r"`torch\.jit\.\w+` is deprecated", DeprecationWarning)
        warnings.filterwarnings("ignore", category=_jit.TracerWarning)
        yield


def _trained(path: Path, text: str | None, network: nn.Module) -> TrainedNetwork:
    content = _content(path, text)
    fixed_size = content["fixed_size"]
    return TrainedNetwork(
        network=network.eval(),
        class_names=tuple(content["class_names"]),
        inputs=tuple(content["inputs"]),
        normalization=Normalization(**content["normalization"]),
        level=content["level"],
        representation=content["representation"],
        image_size=tuple(content["image_size"]),
        size_multiple=content["size_multiple"],
        fixed_size=None if fixed_size is None else tuple(fixed_size),
        settings=content["settings"],
    )


def _content(path: Path, text: str | None) -> dict[str, Any]:
    """The metadata of a file; all fields are there."""
    if not text:
        raise DataError(
            path,
            found=f"no '{METADATA_KEY}' in its metadata",
            expected=_EXPECTED,
            remedy="The file must say which classes and which normalization its network has; "
            "write it with tangent-export.",
        )
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(
            path, found=f"'{METADATA_KEY}' in its metadata is no JSON ({error})", expected=_EXPECTED
        ) from error
    known = content if isinstance(content, dict) else {}
    missing = [name for name in _DESCRIBED if name not in known]
    if missing:
        raise DataError(
            path,
            found=f"no {missing[0]} in '{METADATA_KEY}' of its metadata",
            expected=_EXPECTED,
        )
    return known


def _unreadable(path: Path, error: Exception) -> DataError:
    first_line = str(error).strip().partition("\n")[0]
    return DataError(path, found=f"an unreadable file ({first_line})", expected=_EXPECTED)
