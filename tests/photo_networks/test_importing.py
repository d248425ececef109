"""Outputs of ONNX files become probabilities of the classes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from onnx import helper
from torch import Tensor

from datamodules.core.label_map import LabelMap
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.errors import SettingError
from tangent_train.heads import ClassesHead, head_of
from tangent_train.inference.api import map_classes
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.photo_networks import import_network
from tangent_train.photo_networks.libraries import load_onnx
from tests.models.onnx_files import write_linear

COLORS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 0]], np.float32)
WEIGHT = 8 * COLORS  # scores of the nearest color, about
BIAS = np.array([0.1, -0.2, 0.3, -0.1, 0.2], np.float32) - 4 * COLORS.sum(axis=1)
NAMES = ["a", "b", "c", "d", "e"]


def _node(kind: str, given: str, returned: str, **settings: Any) -> Any:
    return helper.make_node(kind, [given], [returned], **settings)


SOFTMAX = _node("Softmax", "linear", "scores", axis=1)
SOFTMAX_LAST = [
    _node("Softmax", "linear", "p", axis=1),
    _node("Transpose", "p", "scores", perm=[0, 2, 3, 1]),
]
ARGMAX = _node("ArgMax", "linear", "scores", axis=1, keepdims=0)
SIGMOID = _node("Sigmoid", "linear", "scores")


def _imported(path: Path, names: list[str] = NAMES, **settings: Any) -> LoadedNetwork:
    classes = path.with_name("classes.json")
    classes.write_text(json.dumps(names))
    network = load_onnx(file=path, classes=classes, normalization="unit")
    return import_network(
        network, path.with_name("imported.onnx"), levels=5, base_level=0, **settings
    )


def _images(*size: int) -> Tensor:
    return torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(1))


def _linear(images: Tensor, count: int = 5) -> NDArray[np.float64]:
    """``(B, h, w, K)`` in float64."""
    scores = np.einsum("kc,bchw->bhwk", WEIGHT.astype(np.float64), images.double().numpy()) + BIAS
    return np.asarray(scores[..., :count])


@pytest.mark.parametrize(
    ("nodes", "kind"),
    [
        ([], "logits"),
        ([SOFTMAX], "probabilities"),
        (SOFTMAX_LAST, "probabilities"),
        ([SIGMOID], "logits"),
    ],
)
def test_the_default_kind_follows_from_the_sums(
    nodes: list[Any], kind: str, tmp_path: Path
) -> None:
    loaded = _imported(write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, *nodes))
    assert loaded.score_kind == kind
    if nodes != [SIGMOID]:
        powers = np.exp(_linear(_images(16, 24)))
        found = loaded.network(_images(16, 24)).softmax(dim=1).movedim(1, -1)
        np.testing.assert_allclose(found, powers / powers.sum(axis=-1, keepdims=True), atol=1e-5)


def test_label_maps_have_unknown_values(tmp_path: Path) -> None:
    """Of five labels, four are named."""
    path = write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, ARGMAX)
    loaded = _imported(path, NAMES[:4], unknown_classes=["a"])
    assert loaded.score_kind == "labels"
    best = ClassesHead(loaded.class_names).labels_of(loaded.network(_images(16, 24)).argmax(dim=1))
    expected = _linear(_images(16, 24)).argmax(axis=-1)
    np.testing.assert_array_equal(best, np.array([0, 1, 2, 3, 0])[expected])


@pytest.mark.parametrize("names", [["sky"], ["background", "sky"]])
@pytest.mark.parametrize("nodes", [[], [SIGMOID]])
def test_a_single_score_separates_two_classes(names: list[str], nodes: Any, tmp_path: Path) -> None:
    loaded = _imported(write_linear(tmp_path / "net.onnx", WEIGHT[:1], BIAS[:1], *nodes), names)
    expected = 1 / (1 + np.exp(-_linear(_images(16, 24), 1)[..., 0]))
    k = names.index("sky")
    found = loaded.network(_images(16, 24)).softmax(dim=1)[:, k]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    labels = ClassesHead(loaded.class_names).labels_of(
        loaded.network(_images(16, 24)).argmax(dim=1)
    )
    np.testing.assert_array_equal(labels == k + 1, expected > 0.5)


@pytest.mark.parametrize("softmax", [True, False])
def test_sixty_classes_are_certain_where_the_network_is(softmax: bool, tmp_path: Path) -> None:
    """Each class has one color; without the logarithm, no class has a probability above 0.05."""
    colors = np.random.default_rng(3).integers(0, 256, (60, 3))
    weight, bias = 200 * colors / 255, -100 * ((colors / 255) ** 2).sum(axis=1)
    arrays = weight.astype(np.float32), bias.astype(np.float32)
    path = write_linear(tmp_path / "net.onnx", *arrays, *[SOFTMAX] * softmax)
    loaded = _imported(path, list(map(str, range(60))))
    rgb = np.broadcast_to(colors[17].astype(np.uint8), (32, 64, 3))
    merged = LabelMap.of({f"{k}": [f"{k}", f"{k + 30}"] for k in range(30)})
    for network in (loaded, map_classes(loaded, merged).loaded):
        predictor = Predictor(network, head_of(network, min_confidence=0.5), ViewSelector(network))
        mosaic = predictor.predict(InputImage(rgb))
        assert set(np.unique(mosaic.pixels())) == {18}


@pytest.mark.parametrize(
    ("names", "settings", "message"),
    [
        (NAMES[:4], {}, r"found 4, .*expected names of 5 scores"),
        (NAMES, {"unknown_classes": ["x"]}, "x; expected unknown_classes among a, b"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    names: list[str], settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=message):
        _imported(write_linear(tmp_path / "net.onnx", WEIGHT, BIAS), names, **settings)
