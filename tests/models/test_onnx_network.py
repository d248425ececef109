"""ONNX files written by hand, against NumPy."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from models.onnx_network import OnnxNetwork
from tangent_train.errors import DataError, SettingError
from tests.models.onnx_files import write_linear, write_onnx

WEIGHT = np.array([[1.0, -2, 0.5], [0, 3, 1]], np.float32)
BIAS = np.array([0.25, -1], np.float32)


def _linear(path: Path, **settings: Any) -> Path:
    return write_linear(path, WEIGHT, BIAS, **settings)


@pytest.mark.parametrize("shape", [(1, 3, 2, 5), (4, 3, 7, 3)])
def test_scores_are_those_of_the_file(shape: tuple[int, ...], tmp_path: Path) -> None:
    network = OnnxNetwork(_linear(tmp_path / "net.onnx", properties={"who": "a test"}))
    assert network.metadata == {"who": "a test"}
    images = torch.randn(*shape)
    scores = network(images)
    expected = np.einsum("kc,bchw->bkhw", WEIGHT.astype(np.float64), images.double().numpy())
    np.testing.assert_allclose(scores.numpy(), expected + BIAS[:, None, None], atol=1e-6)
    assert scores.dtype == torch.float32
    last = images.contiguous(memory_format=torch.channels_last).requires_grad_()
    torch.testing.assert_close(network(last), scores)
    halves = images.to(torch.bfloat16)
    torch.testing.assert_close(network(halves), network(halves.float()))


def test_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _linear(tmp_path / "net.onnx")
    files = {"missing": None, "empty": b"no protobuf", "cut": whole.read_bytes()[:100]}
    for name, content in files.items():
        path = tmp_path / f"{name}.onnx"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}\.onnx: found an unreadable file"):
            OnnxNetwork(path)
    with pytest.raises(DataError, match=r"; expected one input .*, and one output"):
        OnnxNetwork(_linear(tmp_path / "two.onnx", outputs=("a", "b")))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SettingError, match=r"onnxruntime.*pip install -e '\.\[export\]'"):
        OnnxNetwork(whole)


@pytest.mark.parametrize(
    ("location", "found"),
    [
        ("link.data", "escapes model directory"),
        ("{folder}/out.data", "Absolute path"),
        ("missing.data", "missing.data"),
    ],
)
def test_weights_outside_the_folder_are_refused(tmp_path: Path, location: str, found: str) -> None:
    folder = tmp_path / "net"
    folder.mkdir()
    graph = onnx.load(_linear(tmp_path / "whole.onnx"))
    data: dict[str, Any] = {"location": "out.data", "size_threshold": 0}
    onnx.save(graph, tmp_path / "out.onnx", save_as_external_data=True, **data)
    (folder / "link.data").symlink_to(tmp_path / "out.data")
    graph = onnx.load(tmp_path / "out.onnx", load_external_data=False)
    for entry in (e for t in graph.graph.initializer for e in t.external_data):
        if entry.key == "location":
            entry.value = location.format(folder=tmp_path)
    (folder / "net.onnx").write_bytes(graph.SerializeToString())
    with pytest.raises(DataError, match=rf"net\.onnx: .*{found}.*; expected .* in its folder\.$"):
        OnnxNetwork(folder / "net.onnx")


IDENTITY = helper.make_node("Identity", ["images"], ["scores"])


def test_channels_may_be_last(tmp_path: Path) -> None:
    images = torch.randn(2, 3, 4, 5)
    last = OnnxNetwork(write_onnx(tmp_path / "last.onnx", IDENTITY, shape=("b", "h", "w", 3)))
    torch.testing.assert_close(last(images), images)
    to_last = helper.make_node("Transpose", ["images"], ["scores"], perm=[0, 2, 3, 1])
    mixed = OnnxNetwork(write_onnx(tmp_path / "mixed.onnx", to_last, shape=("b", 3, 4, 5)))
    assert mixed.fixed_size == (4, 5)
    torch.testing.assert_close(mixed(images), images)


def test_as_many_classes_as_rows_and_columns(tmp_path: Path) -> None:
    """The axis of the classes is where the channels of the images are."""
    weight, bias = np.random.default_rng(0).normal(size=(4, 3)), np.zeros(4)
    arrays = weight.astype(np.float32), bias.astype(np.float32)
    images = torch.randn(2, 3, 4, 4)
    expected = torch.einsum("kc,bchw->bkhw", torch.from_numpy(arrays[0]), images)
    first = OnnxNetwork(write_linear(tmp_path / "first.onnx", *arrays))
    torch.testing.assert_close(first(images), expected)
    node = helper.make_node("MatMul", ["images", "weight"], ["scores"])
    path = write_onnx(tmp_path / "last.onnx", node, shape=("b", "h", "w", 3), weight=arrays[0].T)
    torch.testing.assert_close(OnnxNetwork(path)(images), expected)


def test_coarser_scores_are_interpolated_and_labels_repeated(tmp_path: Path) -> None:
    images = torch.randn(2, 3, 8, 12)
    pool = helper.make_node("AveragePool", ["images"], ["p"], kernel_shape=[4, 4], strides=[4, 4])
    scores = helper.make_node("Identity", ["p"], ["scores"])
    coarse = torch.nn.functional.avg_pool2d(images, 4)
    network = OnnxNetwork(write_onnx(tmp_path / "coarse.onnx", pool, scores))
    expected = torch.nn.functional.interpolate(coarse, (8, 12), mode="bilinear")
    torch.testing.assert_close(network(images), expected)
    for keep in (0, 1):
        best = helper.make_node("ArgMax", ["p"], ["scores"], axis=1, keepdims=keep)
        labels = OnnxNetwork(write_onnx(tmp_path / f"labels{keep}.onnx", pool, best))(images)
        assert labels.shape == (2, 1, 8, 12)
        torch.testing.assert_close(labels[:, 0, 1::4, 2::4], coarse.argmax(dim=1).float())
        assert set(labels.unique().tolist()) <= {0, 1, 2}


def test_files_of_a_fixed_batch_and_of_half_precision(tmp_path: Path) -> None:
    images = torch.randn(7, 3, 4, 4)
    for batch in (2, 4):  # the last call has 1 or 3 images
        fixed = OnnxNetwork(write_onnx(tmp_path / "fixed.onnx", IDENTITY, shape=(batch, 3, 4, 4)))
        torch.testing.assert_close(fixed(images), images)
    half = OnnxNetwork(write_onnx(tmp_path / "half.onnx", IDENTITY, kind=TensorProto.FLOAT16))
    assert half(images).dtype == torch.float32
    torch.testing.assert_close(half(images), images.half().float())


@pytest.mark.parametrize(("axes", "batch"), [([0], 1), ([0, 1], 1), ([0], "n")])
def test_outputs_without_an_axis_of_images_are_of_files_for_one(
    axes: list[int], batch: int | str, tmp_path: Path
) -> None:
    """Scores (K, h, w), and one score or labels (h, w)."""
    first = slice(0, 1) if len(axes) > 1 else slice(None)
    squeeze = helper.make_node("Squeeze", ["linear", "axes"], ["scores"])
    tensors = {"axes": np.array(axes)}
    shape = (batch, 3, 6, 7)
    path = tmp_path / "net.onnx"
    write_linear(path, WEIGHT[first], BIAS[first], squeeze, shape=shape, **tensors)
    network, images = OnnxNetwork(path), torch.randn(3, 3, 6, 7)
    if batch == 1:
        plain = OnnxNetwork(write_linear(tmp_path / "plain.onnx", WEIGHT[first], BIAS[first]))
        torch.testing.assert_close(network(images), plain(images))
    else:
        with pytest.raises(SettingError, match="without B only in files whose batch size is 1"):
            network(images[:1])
