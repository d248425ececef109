"""ONNX files written by hand, against NumPy."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from models.onnx_network import OnnxNetwork
from tangent_train.errors import DataError, SettingError

WEIGHT = np.array([[1.0, -2, 0.5], [0, 3, 1]], np.float32)
BIAS = np.array([0.25, -1], np.float32)


def _write(path: Path, shape: Any = ("b", 3, "h", "w"), outputs: tuple[str, ...] = ("a",)) -> Path:
    """Two scores of every pixel, from its three channels."""
    images = helper.make_tensor_value_info("pictures", TensorProto.FLOAT, shape)
    values = [helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in outputs]
    nodes = [helper.make_node("Conv", ["pictures", "weight", "bias"], [n]) for n in outputs]
    weights = [
        numpy_helper.from_array(WEIGHT[:, :, None, None], "weight"),
        numpy_helper.from_array(BIAS, "bias"),
    ]
    graph = helper.make_graph(nodes, "by hand", [images], values, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, {"who": "a test"})
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("shape", [(1, 3, 2, 5), (4, 3, 7, 3)])
def test_scores_are_those_of_the_file(shape: tuple[int, ...], tmp_path: Path) -> None:
    network, images = OnnxNetwork(_write(tmp_path / "net.onnx")), torch.randn(*shape)
    assert network.metadata == {"who": "a test"}
    scores = network(images)
    expected = np.einsum("kc,bchw->bkhw", WEIGHT.astype(np.float64), images.double().numpy())
    np.testing.assert_allclose(scores.numpy(), expected + BIAS[:, None, None], atol=1e-6)
    assert scores.dtype == torch.float32
    last = images.contiguous(memory_format=torch.channels_last).requires_grad_()
    torch.testing.assert_close(network(last), scores)
    halves = images.to(torch.bfloat16)
    torch.testing.assert_close(network(halves), network(halves.float()))


def test_threads_are_torchs_and_cuda_is_used_where_there_is_any(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, opened, session = _write(tmp_path / "net.onnx"), [], onnxruntime.InferenceSession

    def record(file: Path, options: Any, providers: list[str]) -> Any:
        opened.append((options.intra_op_num_threads, providers))
        return session(file, options, providers=["CPUExecutionProvider"])

    both = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "InferenceSession", record)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: both)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    OnnxNetwork(path)
    assert opened == [(3, both)]


def test_images_of_another_shape_are_refused(tmp_path: Path) -> None:
    network = OnnxNetwork(_write(tmp_path / "net.onnx", ("b", 3, 2, 5)))
    with pytest.raises(SettingError, match=r"net\.onnx: found 1×4×2×5; .* b×3×2×5"):
        network(torch.zeros(1, 4, 2, 5))


def test_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _write(tmp_path / "net.onnx")
    files = {"missing": None, "empty": b"no protobuf", "cut": whole.read_bytes()[:100]}
    for name, content in files.items():
        path = tmp_path / f"{name}.onnx"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}\.onnx: found (no such|an unreadable) file"):
            OnnxNetwork(path)
    with pytest.raises(DataError, match=r"outputs \['a', 'b'\]; .* the only output"):
        OnnxNetwork(_write(tmp_path / "two.onnx", outputs=("a", "b")))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(DataError, match=r"onnxruntime.*pip install 'tangent-train\[export\]'"):
        OnnxNetwork(whole)
