"""Kinds of scores are found by trial and converted to probabilities of the classes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper
from torch import Tensor, nn

from datamodules.core.inputs import Normalization
from datamodules.core.label_map import LabelMap
from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import SettingError
from tangent_train.inference.engine import Predictor
from tangent_train.inference.export import export_network
from tangent_train.inference.images import InputImage
from tangent_train.inference.label_maps import map_classes
from tangent_train.inference.representations import PanoramaViews
from tangent_train.photo_networks import PhotoNetwork, import_network
from tangent_train.photo_networks.score_kinds import try_network
from tests.models.onnx_files import write_linear

UNIT = Normalization((0, 0, 0), (1, 1, 1))
COLORS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 0]], np.float32)
WEIGHT = 8 * COLORS  # scores of the nearest color, about
BIAS = np.array([0.1, -0.2, 0.3, -0.1, 0.2], np.float32) - 4 * COLORS.sum(axis=1)
NAMES = ("a", "b", "c", "d", "e")
HALF = TensorProto.FLOAT16


def _node(kind: str, given: str, made: str, *more: str, **settings: Any) -> Any:
    return helper.make_node(kind, [given, *more], [made], **settings)


def _network(path: Path, names: tuple[str, ...] = NAMES, **settings: Any) -> PhotoNetwork:
    return PhotoNetwork(OnnxNetwork(path), None, names, UNIT, (16, 24), **settings)


def _imported(path: Path, names: tuple[str, ...] = NAMES, **settings: Any) -> LoadedNetwork:
    output = path.with_name("imported.onnx")
    import_network(_network(path, names), output, levels=5, base_level=0, **settings)
    return load_network(output)


def _images(*size: int) -> Tensor:
    return torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(1))


def _linear(images: Tensor) -> NDArray[np.float64]:
    """``(B, h, w, K)`` in float64."""
    scores = np.einsum("kc,bchw->bhwk", WEIGHT.astype(np.float64), images.double().numpy()) + BIAS
    return np.asarray(scores)


def _softmax(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    powers = np.exp(scores - scores.max(axis=-1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=-1, keepdims=True))


SOFTMAX = _node("Softmax", "linear", "p", axis=1)
SOFTMAX_ONLY = _node("Softmax", "linear", "scores", axis=1)
BY_HAND = [
    _node("Exp", "linear", "e"),
    _node("ReduceSum", "e", "total", "axes"),
    _node("Div", "e", "scores", "total"),
]


@pytest.mark.parametrize(
    ("nodes", "settings"),
    [
        ([], {}),
        ([_node("LogSoftmax", "linear", "scores", axis=1)], {}),
        ([_node("Softmax", "linear", "scores", axis=1)], {}),
        ([SOFTMAX, _node("Transpose", "p", "scores", perm=[0, 2, 3, 1])], {}),
        ([SOFTMAX, _node("Mul", "p", "scores", "hundred")], {"hundred": np.float32(100)}),
        (BY_HAND, {"axes": np.array([1])}),
    ],
)
def test_softmax_of_the_scores_are_the_networks_probabilities(
    nodes: list[Any], settings: dict[str, Any], tmp_path: Path
) -> None:
    settings = {name: np.asarray(value) for name, value in settings.items()}
    trained = _imported(write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, *nodes, **settings))
    images = _images(16, 24)
    found = trained.network(images).softmax(dim=1).movedim(1, -1)
    np.testing.assert_allclose(found, _softmax(_linear(images)), atol=1e-5)


@pytest.mark.parametrize(
    ("nodes", "expected"),
    [
        ([], "logits"),
        ([_node("Softmax", "linear", "scores", axis=1)], "probabilities"),
        ([_node("Sigmoid", "linear", "scores")], "sigmoid"),
        ([_node("HardSigmoid", "linear", "scores")], "sigmoid"),
        ([_node("Relu", "linear", "scores")], "logits"),
    ],
)
def test_kinds_of_half_precision_and_coarse_scores(
    nodes: list[Any], expected: str, tmp_path: Path
) -> None:
    half = WEIGHT.astype(np.float16), BIAS.astype(np.float16)
    path = write_linear(tmp_path / "half.onnx", *half, *nodes, kind=HALF)
    assert try_network(_network(path)) == (expected, 5)
    if nodes:
        pooled = [_node(nodes[0].op_type, "linear", "p"), _node("AveragePool", "p", "scores")]
        pooled[0].attribute.extend(nodes[0].attribute)
        sides = [helper.make_attribute(name, [4, 4]) for name in ("kernel_shape", "strides")]
        pooled[1].attribute.extend(sides)
        coarse = write_linear(tmp_path / "coarse.onnx", WEIGHT, BIAS, *pooled)
        assert try_network(_network(coarse)) == (expected, 5)


@pytest.mark.parametrize("softmax", [True, False])
def test_sixty_classes_are_certain_where_the_network_is(softmax: bool, tmp_path: Path) -> None:
    """Each class has one color; without the logarithm, no class has a probability above 0.05."""
    colors = np.random.default_rng(3).integers(0, 256, (60, 3))
    weight, bias = 200 * colors / 255, -100 * ((colors / 255) ** 2).sum(axis=1)
    nodes = [_node("Softmax", "linear", "scores", axis=1)] * softmax
    arrays = weight.astype(np.float32), bias.astype(np.float32)
    path = write_linear(tmp_path / "net.onnx", *arrays, *nodes)
    trained = _imported(path, tuple(map(str, range(60))))
    rgb = np.broadcast_to(colors[17].astype(np.uint8), (32, 64, 3))
    merged = LabelMap.of({f"{k}": [f"{k}", f"{k + 30}"] for k in range(30)})
    for network, label in ((trained, 18), (map_classes(trained, merged).trained, 18)):
        views = PanoramaViews(network)
        mosaic = Predictor(network, views, min_confidence=0.5).predict(InputImage(rgb))
        assert set(np.unique(network.labels(mosaic.labels()))) == {label}


def _quantized(levels: int) -> list[Any]:
    """Round to steps of 1 / levels."""
    return [
        _node("Mul", "p", "many", "levels"),
        _node("Round", "many", "rounded"),
        _node("Div", "rounded", "scores", "levels"),
    ]


CLIP = _node("Clip", "p", "scores", "low", "high")
CLIPPED = {"low": np.float32(0.001), "high": np.float32(0.999)}


@pytest.mark.parametrize("count", [5, 60])
@pytest.mark.parametrize(
    ("nodes", "settings"),
    [
        (_quantized(255), {"levels": np.float32(255)}),
        ([_node("Mul", "p", "many", "levels"), _node("Round", "many", "scores")],
         {"levels": np.float32(255)}),
        ([CLIP], CLIPPED),
    ],
)  # fmt: skip
def test_coarse_probabilities_are_those_of_a_softmax(
    nodes: list[Any], settings: dict[str, Any], count: int, tmp_path: Path
) -> None:
    weight = np.concatenate([WEIGHT, np.zeros((count - 5, 3), np.float32)])
    bias = np.concatenate([BIAS, np.full(count - 5, -4, np.float32)])
    constants = {name: np.asarray(value) for name, value in settings.items()}
    names = tuple(map(str, range(count)))
    for kind, expected in ("Softmax", "probabilities"), ("Sigmoid", "sigmoid"):
        if (kind, nodes[-1].op_type) == ("Sigmoid", "Round"):
            continue  # whole numbers without equal sums are refused
        first = _node(kind, "linear", "p", **({"axis": 1} if kind == "Softmax" else {}))
        path = write_linear(tmp_path / "net.onnx", weight, bias, first, *nodes, **constants)
        assert try_network(_network(path, names)) == (expected, count)


def test_a_softmax_over_the_whole_image_gives_probabilities(tmp_path: Path) -> None:
    """ONNX's Softmax before version 13, with axis=1 or none."""
    flat = _node("Flatten", "linear", "flat"), _node("Softmax", "flat", "p", axis=1)
    nodes = [*flat, _node("Shape", "linear", "shape"), _node("Reshape", "p", "scores", "shape")]
    trained = _imported(write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, *nodes))
    images = _images(16, 24)[:1]
    found = trained.network(images).softmax(dim=1).movedim(1, -1)
    np.testing.assert_allclose(found, _softmax(_linear(images)), atol=1e-5)
    path = write_linear(tmp_path / "one.onnx", WEIGHT[:1], BIAS[:1], *nodes)
    with pytest.raises(SettingError, match="scores: found 1 per pixel"):
        _imported(path, NAMES[:1])


@pytest.mark.parametrize("count", [5, 60])
def test_slightly_negative_probabilities_after_a_bicubic_interpolation(
    count: int, tmp_path: Path
) -> None:
    weight = np.concatenate([WEIGHT, np.zeros((count - 5, 3), np.float32)])
    bias = np.concatenate([BIAS, np.full(count - 5, -4, np.float32)])
    pool = _node("AveragePool", "p", "small", kernel_shape=[2, 2], strides=[2, 2])
    resize = helper.make_node("Resize", ["small", "", "scales"], ["scores"], mode="cubic")
    scales = np.array([1, 1, 2, 2], np.float32)
    path = write_linear(tmp_path / "net.onnx", weight, bias, SOFTMAX, pool, resize, scales=scales)
    names = tuple(map(str, range(count)))
    assert try_network(_network(path, names)) == ("probabilities", count)
    stated = _network(path, names, score_kind="probabilities")
    assert try_network(stated) == ("probabilities", count)


THRESHOLD = [
    _node("Greater", "linear", "above", "zero"),
    _node("Cast", "above", "scores", to=TensorProto.UINT8),
]
LABELS = {"returned": TensorProto.UINT8, "zero": np.array(0, np.float32)}
MASK = [
    _node("Greater", "linear", "above", "zero"),
    _node("Where", "above", "scores", "on", "off"),
]
BYTES = LABELS | {"on": np.array(255, np.uint8), "off": np.array(0, np.uint8)}


@pytest.mark.parametrize("names", [("sky",), ("other", "sky")])
@pytest.mark.parametrize(
    ("nodes", "settings"),
    [([], {}), ([_node("Sigmoid", "linear", "scores")], {}), (THRESHOLD, LABELS),
     (MASK, BYTES)],
)  # fmt: skip
def test_one_score_is_of_a_class_and_its_background(
    nodes: list[Any], settings: dict[str, Any], names: tuple[str, ...], tmp_path: Path
) -> None:
    weight, bias = np.array([[4, -4, 2]], np.float32), np.array([-1], np.float32)
    path = write_linear(tmp_path / "net.onnx", weight, bias, *nodes, **settings)
    trained = _imported(path, names)
    assert trained.class_names == ("unknown", *names)
    images = _images(16, 24)
    expected = np.einsum("c,bchw->bhw", weight[0].astype(np.float64), images.double()) - 1
    scores = trained.network(images)
    labels = trained.labels(scores.argmax(dim=1).byte())
    background = 0 if len(names) == 1 else 1
    np.testing.assert_array_equal(labels, np.where(expected > 0, background + 1, background))
    shares = scores.softmax(dim=1)[:, len(names) - 1]
    right = expected > 0 if settings else 1 / (1 + np.exp(-expected))
    np.testing.assert_allclose(shares, right, atol=1e-5)


@pytest.mark.parametrize("suffix", ["ckpt", "safetensors", "onnx"])
def test_one_score_of_a_checkpoint_and_of_its_export(suffix: str, tmp_path: Path) -> None:
    settings = {"_target_": "torch.nn.Conv2d", "in_channels": 3, "out_channels": 1}
    network = nn.Conv2d(3, 1, 1)
    photo = PhotoNetwork(network, settings | {"kernel_size": 1}, ["sky"], UNIT, (16, 24))
    trained = import_network(photo, tmp_path / "net.ckpt", levels=5, base_level=0)
    if suffix != "ckpt":
        export_network(trained, tmp_path / f"net.{suffix}")
    again, images = load_network(tmp_path / f"net.{suffix}"), _images(32, 48)
    with torch.no_grad():
        expected = network(images).sigmoid()
        found = again.network(images).softmax(dim=1)
    torch.testing.assert_close(found[:, :1], expected, atol=1e-5, rtol=1e-4)
    assert again.labels(torch.tensor([0, 1], dtype=torch.uint8)).tolist() == [1, 0]


def test_where_no_sigmoid_is_above_one_half_the_label_is_unknown(tmp_path: Path) -> None:
    sigmoid = _node("Sigmoid", "linear", "scores")
    path = write_linear(tmp_path / "net.onnx", WEIGHT, BIAS - 2, sigmoid)
    images, shown = _images(16, 24), _linear(_images(16, 24)) - 2
    for wins in (True, False):
        trained = _imported(path, unknown_wins=wins)
        labels = trained.labels(trained.network(images).argmax(dim=1).byte())
        best = shown.argmax(axis=-1) + 1
        unknown = (shown.max(axis=-1) < 0) & wins
        assert unknown.any() == wins
        np.testing.assert_array_equal(labels, np.where(unknown, 0, best))


@pytest.mark.parametrize(
    ("returned", "void"),
    [
        (TensorProto.INT64, -1),
        (TensorProto.INT64, 255),
        (TensorProto.INT64, -(2.0**63)),
        (TensorProto.INT32, 300),
        (TensorProto.UINT8, 255),
        (TensorProto.FLOAT, np.nan),
        (TensorProto.FLOAT, -1),
        (TensorProto.FLOAT16, 255),
    ],
)
@pytest.mark.parametrize("keep", [0, 1])
def test_other_values_of_label_maps_are_unknown(
    returned: int, void: float, keep: int, tmp_path: Path
) -> None:
    """Pixels where the network predicts class d."""
    three, of_void = np.array(3), np.array(void)
    nodes = [
        _node("ArgMax", "linear", "best", axis=1, keepdims=keep),
        _node("Equal", "best", "is_void", "three"),
        _node("Cast", "best", "as_floats", to=TensorProto.FLOAT),
        _node("Where", "is_void", "with_void", "void", "as_floats"),
        _node("Cast", "with_void", "scores", to=returned),
    ]
    settings: dict[str, Any] = {"three": three, "void": of_void.astype(np.float32)}
    path = write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, *nodes, returned=returned, **settings)
    names = ("a", "b", "c", "(void)", "e")
    trained = _imported(path, names)
    images = _images(16, 24)
    best = _linear(images).argmax(axis=-1)
    assert set(np.unique(best)) == set(range(5))
    found = trained.network(images)
    labels = trained.labels(found.argmax(dim=1).byte())
    np.testing.assert_array_equal(labels, np.where(best == 3, 0, best + 1))
    assert float(found.softmax(dim=1).amax(dim=1).min()) > 0.999
    with pytest.raises(SettingError, match="unknown_wins: found false, for label maps"):
        _imported(path, names, unknown_wins=False)
    merged = LabelMap.of({"x": ["a", "b"], "y": ["c"]})
    mapped = map_classes(trained, merged).trained
    labels = mapped.labels(mapped.network(images).argmax(dim=1).byte())
    np.testing.assert_array_equal(labels, np.array([1, 1, 2, 0, 0])[best])
    with pytest.raises(SettingError, match="unmapped: found never, for a network that returns lab"):
        map_classes(trained, merged, "never")


@pytest.mark.parametrize("batch", [1, "n"])
def test_one_score_without_an_axis_of_images(batch: int | str, tmp_path: Path) -> None:
    """Files with a fixed batch size of 1 often have no batch axis."""
    nodes = [_node("Sigmoid", "linear", "p"), _node("Squeeze", "p", "scores", "axes")]
    axes, shape = np.array([0, 1]), (batch, 3, 16, 24)
    path = tmp_path / "net.onnx"
    write_linear(path, WEIGHT[:1], BIAS[:1], *nodes, shape=shape, axes=axes)
    if batch == 1:
        assert try_network(_network(path, NAMES[:1])) == ("sigmoid", 1)
        return
    with pytest.raises(SettingError, match=r"output of net\.onnx: found 16×24; .* batch size is 1"):
        try_network(_network(path, NAMES[:1]))


@pytest.mark.parametrize("suffix", ["ckpt", "safetensors", "onnx"])
def test_label_maps_of_a_checkpoint_and_of_its_export(suffix: str, tmp_path: Path) -> None:
    name = f"{LabelMaps.__module__}.{LabelMaps.__qualname__}"
    network, names = LabelMaps(), ("a", "b", "(void)", "c")
    photo = PhotoNetwork(network, {"_target_": name}, names, UNIT, (16, 24))
    settings: dict[str, Any] = {"levels": 5, "base_level": 0, "unknown_classes": ["(void)"]}
    trained = import_network(photo, tmp_path / "net.ckpt", **settings)
    if suffix != "ckpt":
        export_network(trained, tmp_path / f"net.{suffix}")
    again, images = load_network(tmp_path / f"net.{suffix}", [name]), _images(32, 48)
    assert again.score_kind == "labels"
    expected = np.array([1, 2, 0, 3])[network(images)]
    labels = again.labels(again.network(images).argmax(dim=1).byte())
    np.testing.assert_array_equal(labels, expected)
    with pytest.raises(SettingError, match="unmapped: found never, for a network that returns lab"):
        map_classes(again, LabelMap.of({"x": ["a"]}), "never")


class LabelMaps(nn.Module):
    """A network with four labels for bright and dark pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, 4, 1, bias=False)
        generator = torch.Generator().manual_seed(0)
        self.layer.weight.data = torch.randn(4, 3, 1, 1, generator=generator)

    def forward(self, images: Tensor) -> Tensor:
        return self.layer(images).argmax(dim=1)


class Wrong(nn.Module):
    """A network whose scores fit no kind, or have a wrong number."""

    def __init__(self, classes: int, function: Any) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, classes, 1)
        self.function = function

    def forward(self, images: Tensor) -> Tensor:
        returned: Tensor = self.function(self.layer(images))
        return returned


@pytest.mark.parametrize(
    ("classes", "function", "names", "message"),
    [
        (1, lambda x: 255 * x.sigmoid(), NAMES[:1], "scores: found 1 per pixel, from .* to 255"),
        (1, lambda x: (255 * x.sigmoid()).round(), NAMES[:1], "without the factor and set scores="),
        (1, lambda x: 100 * x.sigmoid(), NAMES[:1], "without the factor and set scores=sigmoid"),
        (1, nn.functional.logsigmoid, NAMES[:1], "without the logarithm and set scores=sigmoid"),
        (1, lambda x: x.softmax(1), NAMES[:2], "1 at every pixel, such as a softmax .*scores=sig"),
        (5, lambda x: x * torch.nan, NAMES, "output of the network: found no finite number"),
        (4, lambda x: x.abs().round(), NAMES[:4], "scores: found 4 per pixel, from 0 to"),
        (1, lambda x: x, NAMES[:3], "found 3, for 1 score; .* the background first"),
        (5, lambda x: x, NAMES[:4], "found 4, for 5 scores"),
        (5, lambda x: x.sigmoid(), NAMES[:4], "found 4, for 5 scores"),
        (5, lambda x: x.argmax(1), NAMES[:4], "found 4, for labels 0, 1, 2, 3, 4"),
        (
            *(2, lambda x: x + None, NAMES[:2]),
            r"network: found TypeError \(unsupp.* of 24 × 16 .*If .* another size, set image_size",
        ),
        (2, lambda x: x[:, :, 1:], NAMES[:2], r"output of the network: found \(1, 2, 15, 24\)"),
    ],
)
def test_unclear_scores_are_refused(
    classes: int, function: Any, names: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    torch.manual_seed(2)
    network = PhotoNetwork(Wrong(classes, function), {}, names, UNIT, (16, 24))
    with pytest.raises(SettingError, match=message):
        import_network(network, tmp_path / "net.ckpt", unknown_classes=names[1:2])
    assert not (tmp_path / "net.ckpt").exists()


def test_a_stated_kind_is_used(tmp_path: Path) -> None:
    """Scores after a sigmoid, in the range of probabilities, are still logits if stated."""
    path = write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, _node("Sigmoid", "linear", "scores"))
    trained = _imported(path, score_kind="logits")
    assert (trained.score_kind, trained.groups) == ("logits", None)
    images = _images(16, 24)
    expected = torch.from_numpy(_linear(images)).sigmoid().movedim(-1, 1).float()
    torch.testing.assert_close(trained.network(images), expected, atol=1e-5, rtol=1e-5)
    path = write_linear(tmp_path / "net.onnx", WEIGHT, BIAS)
    with pytest.raises(SettingError, match="scores: found probabilities, but numbers from -"):
        _imported(path, score_kind="probabilities")
    path = write_linear(tmp_path / "one.onnx", WEIGHT[:1], BIAS[:1], SOFTMAX_ONLY)
    with pytest.raises(SettingError, match="scores: found 1 at every pixel"):
        _imported(path, NAMES[:1], score_kind="probabilities")
    nodes = [_node("Sigmoid", "linear", "p"), _node("Mul", "p", "scores", "hundred")]
    hundred = np.array(100, np.float32)
    path = write_linear(tmp_path / "%.onnx", WEIGHT[:1], BIAS[:1], *nodes, hundred=hundred)
    with pytest.raises(SettingError, match=r"found probabilities, but numbers .*the factor and"):
        _imported(path, NAMES[:1], score_kind="probabilities")
