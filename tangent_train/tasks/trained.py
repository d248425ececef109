"""Trained networks from files."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING, Any

from tangent_train.errors import DataError
from tangent_train.tasks.networks import (
    TrainedNetwork,
    completed_settings,
    make_stored,
    network_from,
    size_multiple_of,
)
from tangent_train.tasks.stored_settings import check_stored

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from datamodules.samples import Input

__all__ = ["TrainedNetwork", "inputs_in", "load_trained", "read_checkpoint", "stored_inputs"]

_PREFIX = "network."
"""Begins the names of the network's tensors in a checkpoint."""

_NEEDED = ("resolved_config", "class_names", "normalization", "state_dict")
_SECTIONS = ("network", "representation", "level")
_MADE = ("network", "representation")
_EXPECTED = "a checkpoint written by tangent-train"


def load_trained(path: Path, trust: Collection[str] = ()) -> TrainedNetwork:
    """A trained network, on the CPU and in evaluation mode, from a file of this package.

    Args:
        path: A checkpoint; or what `tangent-export` wrote, known by its suffix ``.onnx`` or
            ``.safetensors``, TorchScript whatever its suffix.
        trust: Classes of networks that are called if the file names them, beside those of this
            package, torch, torchvision, timm and segmentation-models-pytorch: ``my.module.Net``.

    Raises:
        DataError: There is no such file, it holds something else, it names other code, its network
            cannot be made, or a package to read it is missing.
    """
    from tangent_train.tasks import exported

    suffix = path.suffix.lower()
    if suffix == ".onnx":
        return exported.load_onnx(path, trust)
    if suffix == ".safetensors":
        return exported.load_safetensors(path, trust)
    if path.is_file() and exported.is_torchscript(path):
        return exported.load_torchscript(path, trust)
    return _from_checkpoint(path, trust)


def read_checkpoint(path: Path, needed: Sequence[str] = ("config", "state_dict")) -> dict[str, Any]:
    """The content of a checkpoint; nothing but tensors and plain values is unpickled.

    Args:
        path: The file. Tensors stay in it until they are used.
        needed: What must be in it.

    Raises:
        DataError: The file is missing, no checkpoint, or of another program.
    """
    import torch

    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        remedy = "Give its checkpoints/best.ckpt." if path.is_dir() else ""
        raise DataError(path, found=found, expected=_EXPECTED, remedy=remedy)
    if not zipfile.is_zipfile(path):
        raise DataError(path, found="an unreadable file", expected=_EXPECTED)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:
        first_line = str(error).partition("\n")[0]
        raise DataError(
            path, found=f"an unreadable file ({first_line})", expected=_EXPECTED
        ) from error
    missing = [n for n in needed if n not in content] if isinstance(content, dict) else needed
    if missing:
        raise DataError(path, found=f"no {missing[0]} inside", expected=_EXPECTED)
    return dict(content)


def stored_inputs(content: Mapping[str, Any]) -> tuple[Input, ...]:
    """What the network in a checkpoint is shown of images.

    Args:
        content: Of the checkpoint, with its normalization.
    """
    # Older checkpoints do not say it; those of shapes neither, whose six channels are all there is.
    depth: tuple[Input, ...] = ("rgb", "depth")
    return tuple(content.get("inputs") or depth[: len(content["normalization"]["mean"]) - 2])


def inputs_in(path: Path) -> tuple[Input, ...] | None:
    """What the network in a checkpoint or safetensors file is shown, where that is said."""
    from tangent_train.tasks import exported

    try:
        if path.suffix.lower() == ".safetensors":
            return exported.safetensors_inputs(path)
        return stored_inputs(read_checkpoint(path, ("normalization",)))
    except DataError:
        return None


def _check_kind(path: Path, content: dict[str, Any]) -> None:
    """Refuse networks that do not label pixels."""
    kind = content.get("kind", "segmentation")  # which older checkpoints do not say
    if kind != "segmentation":
        raise DataError(
            path,
            found=f"a network for {kind}",
            expected="one for segmentation, with scores of every pixel",
            remedy=f"tangent-evaluate checkpoint={path} is for both.",
        )


def _from_checkpoint(path: Path, trust: Collection[str]) -> TrainedNetwork:
    from datamodules.samples import Normalization, channel_names

    content = read_checkpoint(path, _NEEDED)
    _check_kind(path, content)
    config = content["resolved_config"]
    missing = [name for name in _SECTIONS if config.get(name) is None]
    if missing:
        raise DataError(path, found=f"no {missing[0]} in its config", expected=_EXPECTED)
    check_stored(path, {name: config[name] for name in _MADE}, trust)
    class_names = tuple(content["class_names"])
    normalization = Normalization(**content["normalization"])
    inputs = stored_inputs(content)
    channels = len(channel_names(inputs))
    settings = completed_settings(config["network"], channels, len(class_names), restored=True)
    tensors = {
        name.removeprefix(_PREFIX): tensor
        for name, tensor in content["state_dict"].items()
        if name.startswith(_PREFIX)
    }
    network = network_from(path, settings, tensors)
    rows, columns = make_stored(path, "representation", config["representation"]).image_size
    multiple = size_multiple_of(network, channels)
    return TrainedNetwork(
        network=network,
        class_names=class_names,
        inputs=inputs,
        normalization=normalization,
        level=config["level"],
        representation=config["representation"],
        image_size=(rows, columns),
        size_multiple=multiple or 1,
        fixed_size=None if multiple else (rows, columns),
        settings=settings,
    )
