"""Export a trained network to a file for other programs, verified against PyTorch."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import save_file
from torch import Tensor

from models.distortion_aware import make_ordinary
from tangent_train.checkpoints.loaded import (
    CHECKSUM_KEY,
    METADATA_KEY,
    LoadedNetwork,
    load_network,
    metadata_of,
    tensor_checksum,
    write_metadata,
)
from tangent_train.errors import SettingError, first_line, of_extra
from tangent_train.files import atomic_path
from tangent_train.imports import hide_output

SUFFIXES = (".onnx", ".safetensors")

TOLERANCE = 1e-4
"""Largest difference allowed between outputs of the file and PyTorch, relative to their range."""

_BATCHES = (1, 3)
"""Batch sizes that are compared; the graph is traced with batch size 2."""

_LEAST_TRACED = 32

_SAFETENSORS = "A .safetensors file takes every network."


class Export(NamedTuple):
    """Result of an export.

    Attributes:
        trained: The network, read from the file.
        difference: Largest difference between its scores and PyTorch's, relative to their range.
    """

    trained: LoadedNetwork
    difference: float


def export_network(
    trained: LoadedNetwork,
    path: Path,
    *,
    image_size: tuple[int, int] | None = None,
    opset: int | None = None,
) -> Export:
    """Write a network, read it again and compare it with PyTorch on random images.

    The batch size is dynamic. Height and width are dynamic too (multiples of the network's stride)
    if the exporter supports that; otherwise the file is for the image size of the training.

    Args:
        trained: A network from a checkpoint or a safetensors file.
        path: File to write. ``.onnx`` contains the computation, for onnxruntime and others;
            ``.safetensors`` contains the tensors and the settings of the network. The file is
            created only if the verification succeeds.
        image_size: Fixed rows and columns of an ONNX file; None for dynamic sizes.
        opset: Version of ONNX's operators; None for the exporter's default.

    Raises:
        SettingError: A setting does not fit the format, the network cannot be exported, or the
            scores or the depth differ by more than `TOLERANCE` of their range.
    """
    _check(trained, path, image_size, opset)
    is_onnx = path.suffix.lower() == ".onnx"
    sizes = [image_size or trained.fixed_size]
    if is_onnx and sizes == [None]:
        sizes.append(trained.image_size)
    failure: Exception | None = None
    for size in sizes:
        try:
            with atomic_path(path) as temporary:
                if is_onnx:
                    _write_onnx(trained, size, temporary, opset)
                else:
                    _write_safetensors(trained, temporary)
                return _verified(trained, size, temporary)
        except Exception as error:  # exporters raise many kinds; a fixed size may still work
            if isinstance(error, OSError) or (
                isinstance(error, SettingError) and size == sizes[-1]
            ):
                raise
            failure = error
    cause: Any = failure
    while getattr(cause, "__cause__", None):
        cause = cause.__cause__
    raise SettingError(
        "output",
        found=f"{path.name}, which cannot be written ({first_line(cause)})",
        expected="a network that torch's exporter supports",
        remedy=_SAFETENSORS,
    ) from failure


def _check(
    trained: LoadedNetwork, path: Path, image_size: tuple[int, int] | None, opset: int | None
) -> None:
    if path.suffix.lower() not in SUFFIXES:
        expected = f"a name ending in {' or '.join(SUFFIXES)}"
        raise SettingError("output", found=path.name, expected=expected)
    if trained.settings is None:
        raise SettingError(
            "checkpoint",
            found="an exported network, which contains only the computation",
            expected="a checkpoint of tangent-train, or a safetensors file",
        )
    if path.suffix.lower() == ".safetensors" and (image_size, opset) != (None, None):
        raise SettingError(
            "image_size and opset", found=(image_size, opset), expected="null for .safetensors"
        )
    is_aware = make_ordinary(trained.module) is not trained.module
    if path.suffix.lower() == ".onnx" and (
        is_aware or trained.representation.get("distortion_aware")
    ):
        raise SettingError(
            "output",
            found=f"{path.name}, for distortion-aware convolutions",
            expected="ordinary convolutions: the sampling would be right for one size only",
            remedy=_SAFETENSORS,
        )


def _write_onnx(
    trained: LoadedNetwork, size: tuple[int, int] | None, path: Path, opset: int | None
) -> None:
    with of_extra("export", f"output={path.suffix}"):
        for package in ("onnx", "onnxruntime", "onnxscript"):
            import_module(package)
    written_as = replace(trained, fixed_size=size, settings=None)
    step = trained.size_multiple
    shape: dict[int, Any] = {0: torch.export.Dim("batch")}
    if size is None:
        shape |= {2: step * torch.export.Dim("h"), 3: step * torch.export.Dim("w")}
        least = -(-_LEAST_TRACED // step)
        size = step * max(3, least), step * max(4, least + 1)  # all dimensions differ
    returns_labels = trained.score_kind == "labels"
    with hide_output():
        program: Any = torch.onnx.export(
            trained.module if returns_labels else trained.network,
            (_random_images(trained, 2, size),),
            dynamo=True,
            input_names=["images"],
            output_names=["scores" if trained.depth_kind is None else "depth"],
            dynamic_shapes=(shape,),
            opset_version=opset,
            verbose=False,
        )
    written = program.model.opset_imports[""]
    if opset not in (None, written):
        raise SettingError("opset", found=opset, expected=f"{written} for this network")
    if not returns_labels:  # the graph computes the logits and adds them up
        groups = [[k] for k in range(trained.network.num_scores)] if trained.groups else None
        written_as = replace(written_as, groups=groups, score_kind="logits")
    program.save(path, external_data=False)
    write_metadata(path, path, written_as)


def _write_safetensors(trained: LoadedNetwork, path: Path) -> None:
    # Copies, because the format supports neither shared memory nor other memory formats.
    tensors = trained.module.state_dict()
    tensors = {name: tensor.contiguous().clone() for name, tensor in tensors.items()}
    described = {METADATA_KEY: json.dumps(metadata_of(trained))}
    described |= {CHECKSUM_KEY: tensor_checksum(tensors), "format": "pt"}
    save_file(tensors, path, metadata=described)
    path.chmod(0o644)  # save_file replaces it with a file that only its owner may read


@torch.no_grad()
def _verified(trained: LoadedNetwork, fixed_size: tuple[int, int] | None, path: Path) -> Export:
    """Read the file as a user would, and compare its scores with PyTorch's."""
    exported = load_network(path, trained.source.trust if trained.source else ())
    rows, columns = trained.image_size
    step = trained.size_multiple
    rows, columns = (max(step, side // step * step) for side in (rows, columns))
    sizes = [(rows, columns), (rows + step, columns + 2 * step)]
    largest = 0.0
    for size in sizes if fixed_size is None else [fixed_size]:
        for count in _BATCHES:
            images = _random_images(trained, count, size)
            expected, found = trained.network(images), exported.network(images)
            if found.shape != expected.shape:
                raise ArithmeticError(f"scores {tuple(found.shape)}, not {tuple(expected.shape)}")
            span = float(expected.max() - expected.min())
            difference = float((found - expected).abs().max())
            if not difference <= TOLERANCE * span:  # "not" also refuses NaN
                raise ArithmeticError(
                    f"its scores differ from PyTorch's by {difference:.2g}, of {span:.2g}"
                )
            largest = max(largest, difference / span if span else 0.0)
    return Export(exported, largest)


def _random_images(trained: LoadedNetwork, count: int, size: tuple[int, int]) -> Tensor:
    generator = torch.Generator().manual_seed(count)
    return torch.randn(count, trained.in_channels, *size, generator=generator)
