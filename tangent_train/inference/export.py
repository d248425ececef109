"""Writing a trained network for other programs, and proving that it computes the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, get_args

import torch
from torch import nn

from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.errors import SettingError
from tangent_train.files import atomic_path
from tangent_train.inference.export_formats import WRITE, Format, Plan, random_images

__all__ = ["SUFFIXES", "TOLERANCE", "Export", "Format", "export_network"]

SUFFIXES: dict[Format, str] = {"onnx": ".onnx", "safetensors": ".safetensors"}
"""What the names of the files end with; `load_trained` goes by it."""

TOLERANCE = 1e-4
"""Largest difference to PyTorch, as a share of the range of its scores."""

_PROTOBUF_BYTES = 2**31
"""What a single ONNX file can hold."""

_BATCHES = (1, 3)
"""Images at once when the written file is compared; what is traced has two."""


class Export(NamedTuple):
    """What was written.

    Attributes:
        trained: The network as the file gives it back: with its `fixed_size`.
        difference: Largest difference between a score of the file and PyTorch's.
        share: The same as a share of the range of PyTorch's scores.
    """

    trained: TrainedNetwork
    difference: float
    share: float


class _DifferenceError(Exception):
    """What a file computes is not what the network computes."""


def export_network(
    trained: TrainedNetwork,
    path: Path,
    form: Format,
    *,
    image_size: tuple[int, int] | None = None,
    opset: int | None = None,
) -> Export:
    """Write a network, read it again and compare it with PyTorch on random images.

    Batches may have any length. Height and width may be any multiple of the network's stride where
    the exporter can express that; where it cannot, only the trained size, and the file says so.

    Args:
        trained: The network; of a checkpoint or of a safetensors file.
        path: The file, with the suffix of the format. It appears when all is well, else not at all.
        form: ``onnx``: the computation, for onnxruntime and others. ``safetensors``: the tensors,
            and the settings of the network that takes them.
        image_size: The only rows and columns to write it for; of ONNX.
        opset: Version of ONNX's operators; default the exporter's own.

    Raises:
        SettingError: A setting does not fit the format, the network cannot be exported, or the file
            does not compute the same: scores differ by more than `TOLERANCE` of their range.
    """
    _check(trained, path, form, image_size, opset)
    only = image_size or trained.fixed_size
    write = WRITE[form]
    if only is None and form != "safetensors":
        try:
            return _written(write, Plan(trained, None, opset), path)
        except (SettingError, OSError):
            raise
        except Exception:  # whatever the exporter cannot do with sizes that are left open
            only = trained.image_size
    try:
        return _written(write, Plan(trained, only, opset), path)
    except (SettingError, OSError):
        raise
    except Exception as error:
        raise _refused(form, error) from error


def _written(write: Callable[[Plan, Path], None], plan: Plan, path: Path) -> Export:
    with atomic_path(path) as temporary:
        write(plan, temporary)
        return _compared(plan, temporary)


def _check(
    trained: TrainedNetwork,
    path: Path,
    form: Format,
    image_size: tuple[int, int] | None,
    opset: int | None,
) -> None:
    if form not in get_args(Format):
        raise SettingError("format", found=repr(form), expected=", ".join(get_args(Format)))
    if path.suffix.lower() != SUFFIXES[form]:
        raise SettingError(
            "output", found=path.name, expected=f"a name ending in {SUFFIXES[form]} for {form}"
        )
    if trained.settings is None:
        raise SettingError(
            "checkpoint",
            found="an exported network, of which only the computation is known",
            expected="a checkpoint of tangent-train, or a safetensors file",
        )
    if opset is not None and form != "onnx":
        raise SettingError("opset", found=opset, expected=f"null: {form} has none")
    if image_size is not None:
        _check_size(trained, form, image_size)
    if form == "onnx":
        _check_onnx(trained.network)


def _check_size(trained: TrainedNetwork, form: Format, size: tuple[int, int]) -> None:
    step, fixed = trained.size_multiple, trained.fixed_size
    if form == "safetensors":
        raise SettingError("image_size", found=list(size), expected="null: tensors have none")
    if any(side < 1 or side % step for side in size) or (fixed and size != fixed):
        raise SettingError(
            "image_size",
            found=list(size),
            expected=f"{list(fixed)}" if fixed else f"[height, width], multiples of {step}",
        )


def _check_onnx(network: nn.Module) -> None:
    size = sum(t.numel() * t.element_size() for t in network.state_dict().values())
    if size >= _PROTOBUF_BYTES:
        raise SettingError(
            "format=onnx",
            found=f"a network of {size / 2**30:.1f} GiB",
            expected="less than 2 GiB, what one ONNX file can hold",
            remedy="Use format=safetensors.",
        )


@torch.no_grad()
def _compared(plan: Plan, path: Path) -> Export:
    """Read the file as any user does and compare; raises `_DifferenceError`."""
    trained = plan.trained
    exported = load_trained(path, trained.trust)
    difference = share = 0.0
    for size in plan.compared_sizes:
        for count in _BATCHES:
            images = random_images(plan.trained, count, size)
            expected, found = plan.trained.network(images), exported.network(images)
            if found.shape != expected.shape:
                raise _DifferenceError(f"scores {tuple(found.shape)}, not {tuple(expected.shape)}")
            most = float((found - expected).abs().max())
            span = float(expected.max() - expected.min())
            if not most <= TOLERANCE * span:  # so that NaN is refused too
                raise _DifferenceError(
                    f"scores that differ by {most:.2g} from PyTorch's, whose range is {span:.2g}"
                )
            difference = max(difference, most)
            share = max(share, most / span if span else 0.0)
    return Export(exported, difference, share)


def _refused(form: Format, error: Exception) -> SettingError:
    if isinstance(error, _DifferenceError):
        return SettingError(
            f"format={form}",
            found=str(error),
            expected=f"the same, up to {TOLERANCE:g} of that range",
            remedy="The file was not kept; try another format.",
        )
    cause: BaseException = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    first_line = str(cause).strip().partition("\n")[0] or type(cause).__name__
    return SettingError(
        f"format={form}",
        found=f"a network that cannot be exported ({first_line})",
        expected="one that the exporter of torch understands",
        remedy="format=safetensors takes every network.",
    )
