"""Exported networks: what is written beside the numbers, and reading them again."""

from __future__ import annotations

import json
import re
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
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
from tangent_train.json_text import parse_json
from tangent_train.tasks.networks import TrainedNetwork, network_from
from tangent_train.tasks.stored_settings import check_stored

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
_TOUCHES_FILES = re.compile(rb"\b(?:save|from_file|load_tensor|(?:read|write)_file)\b")
"""Of all operations that torch and torchvision know, those that take the name of a file."""

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


def load_onnx(path: Path, trust: Collection[str] = ()) -> TrainedNetwork:
    """Read an ONNX file; onnxruntime computes.

    Raises:
        DataError: It is none, or none of ours, or onnxruntime is missing.
    """
    network = OnnxNetwork(path)
    content = _content(path, network.metadata.get(METADATA_KEY), trust)
    return _trained(content, network)


def load_torchscript(path: Path, trust: Collection[str] = ()) -> TrainedNetwork:
    """Read a TorchScript archive, on the CPU.

    Raises:
        DataError: It is none, or none of ours, or would read or write files itself.
    """
    _check_script(path)
    extra: dict[str, Any] = {METADATA_KEY: ""}
    try:
        with torchscript_without_warnings():
            network: nn.Module = _jit.load(path, map_location="cpu", _extra_files=extra)
    except (RuntimeError, ValueError) as error:
        raise _unreadable(path, error) from error
    text = extra[METADATA_KEY]
    return _trained(_content(path, text, trust), network)


def load_safetensors(path: Path, trust: Collection[str] = ()) -> TrainedNetwork:
    """Read tensors, and make the network they belong to.

    Raises:
        DataError: It is no such file, or none of ours, its network cannot be made, or the package
            safetensors is missing.
    """
    with _safetensors(path) as file:
        text = (file.metadata() or {}).get(METADATA_KEY)
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    content = _content(path, text, trust)
    if not content["settings"]:
        raise DataError(path, found="no settings of the network inside", expected=_EXPECTED)
    network = network_from(path, content["settings"], tensors)
    return _trained(content, network)


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


def _check_script(path: Path) -> None:
    """Refuse programs that touch files, which TorchScript can do as soon as it is loaded.

    Raises:
        DataError: It would, or its parts cannot be told apart.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            code = [archive.read(name) for name in names if name.endswith(".py")]
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise _unreadable(path, error) from error
    if len(set(names)) < len(names):  # other programs may read another one of that name
        raise DataError(path, found="two parts of one name", expected=_EXPECTED)
    found = next(filter(None, map(_TOUCHES_FILES.search, code)), None)
    if found:
        raise DataError(
            path,
            found=f"a program that calls {found[0].decode()}",
            expected="one that computes and leaves files alone",
        )


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


def _trained(content: Mapping[str, Any], network: nn.Module) -> TrainedNetwork:
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


def _content(
    path: Path, text: str | bytes | None, trust: Collection[str] | None = None
) -> dict[str, Any]:
    """The metadata of a file; all fields are there, and name no code that is not trusted.

    Args:
        path: The file, for the messages.
        text: The JSON.
        trust: See `load_trained`; None where nothing is made of it.
    """
    if not text:
        raise DataError(
            path,
            found=f"no '{METADATA_KEY}' in its metadata",
            expected=_EXPECTED,
            remedy="The file must say which classes and which normalization its network has; "
            "write it with tangent-export.",
        )
    try:
        content = parse_json(text)
    except ValueError as error:
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
    if trust is not None:
        check_stored(path, {name: known[name] for name in ("settings", "representation")}, trust)
    return known


def _unreadable(path: Path, error: Exception) -> DataError:
    first_line = str(error).strip().partition("\n")[0]
    return DataError(path, found=f"an unreadable file ({first_line})", expected=_EXPECTED)
