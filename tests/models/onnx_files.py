"""ONNX files written by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper


def write_onnx(
    path: Path,
    *nodes: Any,
    shape: Sequence[Any] = ("n", 3, "h", "w"),
    kind: int = TensorProto.FLOAT,
    returned: int | None = None,
    outputs: Sequence[str] = ("scores",),
    properties: dict[str, str] | None = None,
    **tensors: NDArray[Any],
) -> Path:
    """A network of nodes from "images" to the outputs, which are of the type `returned`."""
    images = helper.make_tensor_value_info("images", kind, shape)
    last = returned or (TensorProto.INT64 if nodes[-1].op_type == "ArgMax" else kind)
    values = [helper.make_tensor_value_info(name, last, None) for name in outputs]
    constants = [numpy_helper.from_array(tensor, name) for name, tensor in tensors.items()]
    graph = helper.make_graph(nodes, "theirs", [images], values, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, properties or {})
    onnx.save(model, path)
    return path


def write_linear(
    path: Path,
    weight: NDArray[np.floating],
    bias: NDArray[np.floating],
    *after: Any,
    **settings: Any,
) -> Path:
    """Scores ``weight · pixel + bias`` of every pixel, and nodes that begin with "linear"."""
    outputs = ["linear"] if after else settings.get("outputs", ("scores",))
    nodes = [helper.make_node("Conv", ["images", "weight", "bias"], [name]) for name in outputs]
    return write_onnx(path, *nodes, *after, weight=weight[:, :, None, None], bias=bias, **settings)
