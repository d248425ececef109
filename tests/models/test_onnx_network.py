"""ONNX files, written by hand, as networks."""

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

WEIGHT = np.array([[1, -2, 0.5], [0, 3, 1]], np.float32)
BIAS = np.array([0.25, -1], np.float32)


def _write(
    path: Path, shape: tuple[Any, ...] = ("b", 3, "h", "w"), *, second_output: bool = False
) -> Path:
    """Two scores of every pixel, from its three channels."""
    images = helper.make_tensor_value_info("pictures", TensorProto.FLOAT, shape)
    names = ["planes", "more"] if second_output else ["planes"]
    outputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in names]
    nodes = [helper.make_node("Conv", ["pictures", "weight", "bias"], ["planes"])]
    nodes += [helper.make_node("Relu", ["planes"], ["more"])] if second_output else []
    weights = [
        numpy_helper.from_array(WEIGHT[:, :, None, None], "weight"),
        numpy_helper.from_array(BIAS, "bias"),
    ]
    graph = helper.make_graph(nodes, "by hand", [images], outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, {"who": "a test"})
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("shape", [(1, 3, 2, 5), (4, 3, 7, 3)])
def test_scores_are_those_of_the_file(shape: tuple[int, ...], tmp_path: Path) -> None:
    network = OnnxNetwork(_write(tmp_path / "net.onnx"))
    images = torch.randn(*shape)
    scores = network(images)
    expected = np.einsum("kc,bchw->bkhw", WEIGHT.astype(np.float64), images.double().numpy())
    np.testing.assert_allclose(scores.numpy(), expected + BIAS[:, None, None], atol=1e-6)
    assert scores.dtype == torch.float32
    assert scores.device == images.device
    assert not scores.requires_grad


def test_images_of_other_kinds_are_converted(tmp_path: Path) -> None:
    network = OnnxNetwork(_write(tmp_path / "net.onnx")).eval()
    images = torch.randn(2, 3, 4, 6)
    expected = network(images)
    last = images.contiguous(memory_format=torch.channels_last).requires_grad_()
    torch.testing.assert_close(network(last), expected)
    halves = images.to(torch.bfloat16)
    torch.testing.assert_close(network(halves), network(halves.float()))


def test_metadata_is_handed_on(tmp_path: Path) -> None:
    assert OnnxNetwork(_write(tmp_path / "net.onnx")).metadata == {"who": "a test"}


def test_it_runs_on_torch_s_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _write(tmp_path / "net.onnx")
    opened: list[tuple[Any, Any]] = []
    session = onnxruntime.InferenceSession

    def record(file: Path, options: Any, providers: list[str]) -> Any:
        opened.append((options.intra_op_num_threads, providers))
        return session(file, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(onnxruntime, "InferenceSession", record)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    network = OnnxNetwork(path)
    network(torch.zeros(1, 3, 2, 2))
    assert opened == [(3, ["CPUExecutionProvider"])]


def test_images_on_a_gpu_use_its_provider_where_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path / "net.onnx")
    providers: list[list[str]] = []
    session = onnxruntime.InferenceSession

    def record(file: Path, options: Any, providers: list[str]) -> Any:
        opened.append(providers)
        return session(file, options, providers=["CPUExecutionProvider"])

    opened = providers
    monkeypatch.setattr(onnxruntime, "InferenceSession", record)
    network = OnnxNetwork(path)
    images = _OnGpu(torch.ones(1, 3, 2, 2))
    expected = network(torch.ones(1, 3, 2, 2))
    torch.testing.assert_close(network(images).as_subclass(torch.Tensor), expected)
    assert providers == [["CPUExecutionProvider"]]  # there is none for CUDA
    both = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: both)
    network(images)
    network(images)
    assert providers == [["CPUExecutionProvider"], both]  # opened once, with a fallback
    network(torch.ones(1, 3, 2, 2))
    assert len(providers) == 2


class _OnGpu(torch.Tensor):
    """Says that it is on a GPU; its numbers are on the CPU."""

    @property
    def is_cuda(self) -> bool:  # type: ignore[override]
        return True


@pytest.mark.parametrize("shape", [(1, 4, 2, 5), (1, 3, 3, 5)])
def test_images_of_another_shape_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    network = OnnxNetwork(_write(tmp_path / "net.onnx", ("b", 3, 2, 5)))
    found = "×".join(map(str, shape))
    with pytest.raises(SettingError, match=rf"images for net\.onnx: found {found}; .* b×3×2×5"):
        network(torch.zeros(*shape))


def test_other_files_are_refused(tmp_path: Path) -> None:
    missing, broken = tmp_path / "missing.onnx", tmp_path / "broken.onnx"
    with pytest.raises(DataError, match=r"missing\.onnx: found no such file"):
        OnnxNetwork(missing)
    broken.write_bytes(b"no protobuf")
    with pytest.raises(DataError, match=r"broken\.onnx: found an unreadable file"):
        OnnxNetwork(broken)
    whole = _write(tmp_path / "net.onnx").read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"broken\.onnx: found an unreadable file"):
        OnnxNetwork(broken)
    with pytest.raises(DataError, match=r"outputs \['planes', 'more'\]; .* the only output"):
        OnnxNetwork(_write(tmp_path / "two.onnx", second_output=True))
    with pytest.raises(DataError, match=r"inputs \['pictures'\].*the only input"):
        OnnxNetwork(_write_flat(tmp_path / "flat.onnx"))


def _write_flat(path: Path) -> Path:
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, (3, "h", "w"))
        for name in ("pictures", "planes")
    ]
    node = helper.make_node("Relu", ["pictures"], ["planes"])
    graph = helper.make_graph([node], "by hand", values[:1], values[1:])
    opsets = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=10), path)
    return path


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _write(tmp_path / "net.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(DataError, match=r"onnxruntime.*pip install 'tangent-train\[export\]'"):
        OnnxNetwork(path)
