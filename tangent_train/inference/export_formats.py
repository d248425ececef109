"""How a trained network is written in each format."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import save_file
from torch import Tensor

from tangent_train.checkpoints.trained import METADATA_KEY, TrainedNetwork, metadata_json
from tangent_train.errors import SettingError

__all__ = ["WRITE", "Format", "Plan", "random_images"]

Format = Literal["onnx", "safetensors"]


@dataclass(frozen=True)
class Plan:
    """What is to be written: a network for images of any size, or of one.

    Attributes:
        trained: The network.
        size: Its only size; None for any.
        opset: Of ONNX; None for the exporter's own.
    """

    trained: TrainedNetwork
    size: tuple[int, int] | None
    opset: int | None

    @property
    def metadata(self) -> str:
        """What is written beside the numbers."""
        return metadata_json(replace(self.trained, fixed_size=self.size))

    @property
    def metadata_without_settings(self) -> str:
        """The same for formats that hold the computation itself."""
        return metadata_json(replace(self.trained, fixed_size=self.size, settings=None))

    @property
    def traced_images(self) -> Tensor:
        """Images to trace the network with: two, and no two sizes alike."""
        multiple = self.trained.size_multiple
        least = -(-32 // multiple)
        rows, columns = self.size or (multiple * max(3, least), multiple * max(4, least + 1))
        return random_images(self.trained, 2, (rows, columns))

    @property
    def compared_sizes(self) -> list[tuple[int, int]]:
        """Sizes the file must agree on: the trained one, and another if it takes any."""
        if self.size is not None:
            return [self.size]
        rows, columns = self.trained.image_size
        step = self.trained.size_multiple
        rows, columns = (max(step, side // step * step) for side in (rows, columns))
        return [(rows, columns), (rows + step, columns + 2 * step)]


def random_images(trained: TrainedNetwork, count: int, size: tuple[int, int]) -> Tensor:
    """Images ``(count, C, h, w)`` as a normalized network takes them, always the same."""
    generator = torch.Generator().manual_seed(count)
    return torch.randn(count, trained.in_channels, *size, generator=generator)


def _write_onnx(plan: Plan, path: Path) -> None:
    _import_onnx()
    network, images = plan.trained.network, plan.traced_images
    step = plan.trained.size_multiple
    shape: dict[int, Any] = {0: torch.export.Dim("batch")}
    if plan.size is None:
        shape[2], shape[3] = step * torch.export.Dim("h"), step * torch.export.Dim("w")
    with _quiet_exporter():
        program: Any = torch.onnx.export(
            network,
            (images,),
            dynamo=True,
            input_names=["images"],
            output_names=["scores"],
            dynamic_shapes=(shape,),
            opset_version=plan.opset,
            verbose=False,
        )
    written = program.model.opset_imports[""]
    if plan.opset not in (None, written):
        raise SettingError("opset", found=plan.opset, expected=f"{written} for this network")
    program.model.metadata_props[METADATA_KEY] = plan.metadata_without_settings
    program.save(path, external_data=False)


def _import_onnx() -> None:
    try:
        import onnx
        import onnxruntime
        import onnxscript
    except ImportError as error:
        raise SettingError(
            "format=onnx",
            found=f"no package {error.name}",
            expected="the packages for ONNX",
            remedy="Run: pip install 'tangent-train[export]'",
        ) from error
    del onnx, onnxruntime, onnxscript


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Leave out what the exporter tells its developers: warnings, logs, listings of the network.

    Nothing is lost: what it cannot do raises, and what it has written is compared with PyTorch.
    """
    disabled = logging.root.manager.disable
    logging.disable()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                yield
    finally:
        logging.disable(disabled)


def _write_safetensors(plan: Plan, path: Path) -> None:
    network: Any = plan.trained.network
    # Copies: the format knows neither tensors that share memory nor other memory formats.
    tensors = {
        name: tensor.contiguous().clone() for name, tensor in network.network.state_dict().items()
    }
    save_file(tensors, path, metadata={"format": "pt", METADATA_KEY: plan.metadata})
    path.chmod(0o644)  # it was replaced by one that only its owner may read


WRITE: dict[Format, Callable[[Plan, Path], None]] = {
    "onnx": _write_onnx,
    "safetensors": _write_safetensors,
}
"""Write a file as planned, by format."""
