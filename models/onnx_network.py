"""An ONNX file as a network."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tangent_train.errors import DataError, SettingError, first_line, of_extra

_TYPES = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16}
_COLORS = 3
_LABEL_MAP = 3
"""Dimensions of label maps."""

_ERRORS_ONLY = 3
"""Log level of onnxruntime, whose warnings are about speed."""


class OnnxNetwork(nn.Module):
    """Runs an ONNX file with onnxruntime, on as many threads as torch uses.

    Its CUDA provider is used if torch and onnxruntime have CUDA (package onnxruntime-gpu). Scores
    are on the device of the images. The network has no parameters and no gradients.

    Args:
        path: ONNX file with one input ``(B, C, h, w)`` or ``(B, h, w, 3)``, float32 or float16,
            and one output: scores (channels first or last) or label maps, of any resolution.
            onnxruntime reads weights in files of their own (external data) from its folder only.

    Attributes:
        path: ONNX file.
        metadata: Metadata of the file, text by key.
        fixed_size: Fixed rows and columns of images; None for a side of any length.

    Raises:
        DataError: The file is missing, or has other inputs or outputs.
        SettingError: onnxruntime is missing.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        with of_extra("export", path):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = _ERRORS_ONLY
        # Spinning threads would take the cores from the work on the scores.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        usable = ["CPUExecutionProvider", *["CUDAExecutionProvider"] * torch.cuda.is_available()]
        providers = [name for name in onnxruntime.get_available_providers() if name in usable]
        try:
            options.add_session_config_entry("session.load_model_format", "ONNX")
            self._session = onnxruntime.InferenceSession(path, options, providers=providers)
        except Exception as error:  # the parser of protocol buffers raises many kinds of errors
            found = f"an unreadable file ({first_line(error).rpartition('Error: ')[2]})"
            expected = "an ONNX file; weights in files of their own are in its folder"
            raise DataError(path, found=found, expected=expected) from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if [(len(i.shape), i.type in _TYPES) for i in inputs] != [(4, True)] or len(outputs) != 1:
            found = ", ".join(f"{one.name} {one.type} {one.shape}" for one in [*inputs, *outputs])
            expected = f"one input (B, C, h, w) of {' or '.join(_TYPES)}, and one output"
            raise DataError(path, found=found, expected=expected)
        self._input = inputs[0]
        shape = self._input.shape
        self._channels_last = shape[3] == _COLORS and shape[1] != _COLORS
        self._batch = shape[0] if isinstance(shape[0], int) else None
        rows, columns = shape[1:3] if self._channels_last else shape[2:]
        known = isinstance(rows, int) and isinstance(columns, int)
        self.fixed_size: tuple[int, int] | None = (rows, columns) if known else None
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def forward(self, images: Float[Tensor, "batch channels height width"]) -> Tensor:
        """Return scores ``(B, K, h, w)`` of every pixel as float32, label maps with K = 1.

        Raises:
            SettingError: The file returns another output.
        """
        array = images.movedim(1, -1) if self._channels_last else images
        array = array.detach().to("cpu", _TYPES[self._input.type])
        size = self._batch or max(1, len(array))
        parts = [self._run(part, images) for part in torch.split(array, size)]
        return (parts[0] if len(parts) == 1 else torch.cat(parts)).to(images.device)

    def _run(self, part: Tensor, images: Tensor) -> Tensor:
        """Return scores or labels of some images, of the size of the images."""
        missing = 0 if self._batch is None else self._batch - len(part)
        if missing:
            part = torch.cat([part, part[-1:].expand(missing, -1, -1, -1)])
        whole = part.contiguous().numpy()
        (returned,) = self._session.run(None, {self._input.name: whole})
        size = (images.shape[2], images.shape[3])
        count = len(whole) - missing
        output = torch.from_numpy(returned)
        if self._batch == 1 and (
            output.ndim == _LABEL_MAP - 1 or (output.ndim == _LABEL_MAP and len(output) != 1)
        ):
            output = output[None]  # the file has no batch axis
        fits = output.ndim > 0 and len(output) == len(whole)
        scores = _channels_first(output[:count], size, self._channels_last) if fits else None
        if scores is None:
            raise SettingError(
                f"output of {self.path.name}",
                found="×".join(map(str, returned.shape)),
                expected="scores (B, K, h, w) or (B, h, w, K), or labels (B, h, w); without B only "
                "in files whose batch size is 1",
            )
        scores = scores.float()
        if scores.shape[2:] == size:
            return scores
        if scores.shape[1] == 1 and bool(((scores == scores.round()) | scores.isnan()).all()):
            return functional.interpolate(scores, size)  # whole numbers: labels
        return functional.interpolate(scores, size, mode="bilinear")


def _channels_first(returned: Tensor, size: tuple[int, int], last: bool) -> Tensor | None:
    """Return an output as ``(B, K, h, w)``, maps with K = 1; None for other shapes.

    The axis of the classes is found by the others: rows and columns have the same stride.

    Args:
        returned: Output of the network.
        size: Rows and columns of the images.
        last: True if the channels of the images are last; used if both axes are possible.
    """
    if returned.ndim == _LABEL_MAP:
        returned = returned[:, None]
    if returned.ndim != _LABEL_MAP + 1:
        return None
    shapes = {1: returned.shape[2:], -1: returned.shape[1:3]}
    fitting = [a for a, (h, w) in shapes.items() if abs(h * size[1] - w * size[0]) <= max(size)]
    if not fitting:
        return None
    axis = (-1 if last else 1) if len(fitting) > 1 else fitting[0]
    return returned.movedim(axis, 1)
