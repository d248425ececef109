"""An ONNX file as a network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tangent_train.errors import DataError, SettingError

__all__ = ["OnnxNetwork"]

_ERRORS_ONLY = 3
"""Of onnxruntime's log levels: its warnings are about speed."""


class OnnxNetwork(nn.Module):
    """Runs an ONNX file with onnxruntime, on as many threads as torch uses.

    Its CUDA provider is used where torch and onnxruntime have CUDA (package onnxruntime-gpu); the
    scores are on the device of the images in any case. It has no parameters and no gradients.

    Args:
        path: The file; one input ``(B, C, h, w)`` float32, one output.

    Attributes:
        metadata: The file's own, text by key.

    Raises:
        DataError: There is no such file, it is no network of this kind, it needs other files, or
            onnxruntime is missing.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        if not path.is_file():
            raise DataError(path, found="no such file", expected="an ONNX file")
        try:
            import onnx
            import onnxruntime
        except ImportError as error:
            raise DataError(
                path,
                found="an ONNX file",
                expected="the packages onnx and onnxruntime, to run it",
                remedy="Run: pip install 'tangent-train[export]'",
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = _ERRORS_ONLY
        usable = {"CPUExecutionProvider"}
        usable |= {"CUDAExecutionProvider"} if torch.cuda.is_available() else set()
        providers = [name for name in onnxruntime.get_available_providers() if name in usable]
        try:
            graph = onnx.load(path, load_external_data=False)
            if not any(tensor.data_location for tensor in _tensors(graph)):
                self._session = onnxruntime.InferenceSession(path, options, providers=providers)
        except Exception as error:  # whatever the parser of protocol buffers raises
            found = f"an unreadable file ({str(error).partition(chr(10))[0]})"
            raise DataError(path, found=found, expected="an ONNX file") from error
        if not hasattr(self, "_session"):
            raise DataError(
                path,
                found="tensors in other files",
                expected="a self-contained network",
                remedy="Save it with its weights in the file.",
            )
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [len(i.shape) for i in inputs] != [4] or len(outputs) != 1:
            raise DataError(
                path,
                found=f"inputs {[i.name for i in inputs]}, outputs {[o.name for o in outputs]}",
                expected="images (B, C, h, w) as the only input, scores as the only output",
            )
        self._input = inputs[0]
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Scores of every pixel.

        Raises:
            SettingError: The file was made for images of another shape.
        """
        array = images.detach().to("cpu", torch.float32).contiguous().numpy()
        try:
            (scores,) = self._session.run(None, {self._input.name: array})
        except Exception as error:
            raise SettingError(
                f"images for {self._path.name}",
                found="×".join(map(str, images.shape)),
                expected="×".join(map(str, self._input.shape)),
                remedy=f"onnxruntime says: {str(error).partition(chr(10))[0]}",
            ) from error
        return torch.from_numpy(scores).to(images.device)


def _tensors(message: Any) -> Iterator[Any]:
    """All tensors in a message and in those inside it."""
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in value if hasattr(value, "__len__") else [value]:
                if field.message_type.name == "TensorProto":
                    yield inner
                else:
                    yield from _tensors(inner)
