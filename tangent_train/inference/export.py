"""Export a network to a file for other programs, verified against PyTorch."""

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
    METADATA_KEY,
    LoadedNetwork,
    load_network,
    write_onnx_description,
)
from tangent_train.checkpoints.outputs import example_inputs, plain_output
from tangent_train.errors import SettingError, check_choice, first_line, of_extra
from tangent_train.files import atomic_path
from tangent_train.imports import hide_output

SUFFIXES = (".onnx", ".safetensors")

TOLERANCE = 1e-4
"""Largest difference allowed between outputs of the file and PyTorch, relative to their range."""

_BATCHES = (1, 3)
"""Batch sizes that are compared; the graph is traced with batch size 2."""

_LEAST_TRACED = 32


class Export(NamedTuple):
    """Result of an export.

    Attributes:
        loaded: The network, read from the file.
        difference: Largest difference between its output and PyTorch's, relative to their range.
    """

    loaded: LoadedNetwork
    difference: float


def export_network(
    loaded: LoadedNetwork,
    path: Path,
    *,
    image_size: tuple[int, int] | None = None,
    opset: int | None = None,
) -> Export:
    """Write a network, read it again and compare it with PyTorch on random images.

    The batch size is dynamic. Height and width are dynamic too (multiples of the network's stride)
    if the exporter supports that; otherwise the file is for the image size of the training.

    Args:
        loaded: A network from a checkpoint or a safetensors file.
        path: File to write. ``.onnx`` contains the computation, for onnxruntime and others;
            ``.safetensors`` contains the tensors and the settings of the network. The file is
            created only if the verification succeeds.
        image_size: Fixed rows and columns of an ONNX file; None for dynamic sizes.
        opset: Version of ONNX's operators; None for the exporter's default.

    Raises:
        SettingError: A setting does not fit the format, the network cannot be exported, or the
            scores or the depth differ by more than `TOLERANCE` of their range.
    """
    check_choice("output", path.suffix.lower(), SUFFIXES)
    step = loaded.size_multiple
    if image_size is not None and any(side % step for side in image_size):
        raise SettingError("image_size", found=image_size, expected=f"multiples of {step}")
    is_onnx = path.suffix.lower() == ".onnx"
    is_aware = make_ordinary(loaded.module) is not loaded.module
    is_aware |= bool(loaded.representation.get("distortion_aware"))
    sizes = [image_size or loaded.fixed_size]
    if is_onnx and sizes == [None]:
        sizes.append(loaded.image_size)
    failure: object = None
    if loaded.settings is None:
        failure = "an exported network contains only the computation"
    elif is_onnx and is_aware:
        failure = "distortion-aware convolutions would be right for one size only"
    elif is_onnx and getattr(loaded.network, "takes_cameras", False):
        failure = "an ONNX file takes images without their cameras"
    for size in sizes if failure is None else ():
        try:
            with atomic_path(path) as temporary:
                if is_onnx:
                    _write_onnx(loaded, size, temporary, opset)
                else:
                    _write_safetensors(loaded, temporary)
                return _verified(loaded, size, temporary)
        except OSError:
            raise
        except Exception as error:  # exporters raise many kinds; a fixed size may still work
            failure = error
    raise SettingError(
        "output",
        found=f"{path.name}, which cannot be written ({first_line(failure)})",
        expected="a network that torch's exporter supports",
        remedy="A .safetensors file takes every network of a checkpoint.",
    )


def _write_onnx(
    loaded: LoadedNetwork, size: tuple[int, int] | None, path: Path, opset: int | None
) -> None:
    with of_extra("export", f"output={path.suffix}"):
        for package in ("onnx", "onnxruntime", "onnxscript"):
            import_module(package)
    step = loaded.size_multiple
    shape: dict[int, Any] = {0: torch.export.Dim("batch")}
    fixed = size
    if size is None:
        shape |= {2: step * torch.export.Dim("h"), 3: step * torch.export.Dim("w")}
        least = -(-_LEAST_TRACED // step)
        size = step * max(3, least), step * max(4, least + 1)  # all dimensions differ
    returns_labels = loaded.score_kind == "labels"
    with hide_output():
        program: Any = torch.onnx.export(
            loaded.module if returns_labels else replace(loaded, photo_fov_deg=None).network,
            (_random_images(loaded, 2, size),),
            dynamo=True,
            input_names=["images"],
            output_names=["scores" if loaded.depth_kind is None else "depth"],
            dynamic_shapes=(shape,),
            opset_version=opset,
            verbose=False,
        )
    if len(program.model.graph.outputs) > 1:
        raise SettingError("network", found="further outputs, e.g. a confidence", expected="one")
    program.save(path, external_data=False)
    written = replace(loaded, fixed_size=fixed, settings=None)
    if not returns_labels:  # the graph computes the logits and adds them up
        count = getattr(loaded.network, "num_outputs", 1)
        groups = tuple((k,) for k in range(count)) if loaded.groups else None
        written = replace(written, groups=groups, score_kind="logits")
    write_onnx_description(path, path, written)


def _write_safetensors(loaded: LoadedNetwork, path: Path) -> None:
    # Copies, because the format supports neither shared memory nor other memory formats.
    tensors = loaded.module.state_dict()
    tensors = {name: tensor.contiguous().clone() for name, tensor in tensors.items()}
    save_file(tensors, path, metadata={METADATA_KEY: json.dumps(loaded.plain()), "format": "pt"})
    path.chmod(0o644)  # save_file replaces it with a file that only its owner may read


@torch.no_grad()
def _verified(loaded: LoadedNetwork, fixed_size: tuple[int, int] | None, path: Path) -> Export:
    """Read the file as a user would, and compare its output with PyTorch's."""
    exported = load_network(path, loaded.trust)
    step, largest = loaded.size_multiple, 0.0
    rows, columns = (max(step, side // step * step) for side in loaded.image_size)
    sizes = [(rows, columns), (rows + step, columns + 2 * step)]
    for size in sizes if fixed_size is None else [fixed_size]:
        for count in _BATCHES:
            images = _random_images(loaded, count, size)
            inputs = example_inputs(loaded.network, images)
            expected, found = (plain_output(each.network(*inputs)) for each in (loaded, exported))
            span = float(expected.max() - expected.min())
            torch.testing.assert_close(
                found,
                expected,
                rtol=0,
                atol=TOLERANCE * span,
                msg=lambda text: "its output differs from PyTorch's: " + " ".join(text.split()),
            )
            difference = float((found - expected).abs().max())
            largest = max(largest, difference / span if span else 0.0)
    return Export(exported, largest)


def _random_images(loaded: LoadedNetwork, count: int, size: tuple[int, int]) -> Tensor:
    generator = torch.Generator().manual_seed(count)
    return torch.randn(count, loaded.in_channels, *size, generator=generator)
