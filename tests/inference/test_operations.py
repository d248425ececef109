"""On a device, few operations are run outside of the network."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tangent_train.heads import head_of
from tangent_train.inference import engine
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.rendering import mosaic
from tests.inference.trained import TANGENT, sphere, trained_network
from tests.operations import Operations

LEVEL = 6
HORIZONTAL = {
    "option": "horizontal",
    "dim": 64,
    "rings": [{"pitch": 0, "views": 8}, {"pitch": 50, "views": 4}, {"pitch": -50, "views": 4}],
    "fov": 90,
}
TANGENT_20 = {"option": "tangent", "base_level": 0}


def _operations(monkeypatch: pytest.MonkeyPatch, count: int, **settings: Any) -> Operations:
    """Predict a panorama in calls of 4 views with a network of some outputs."""
    original = mosaic.Mosaic.__init__
    monkeypatch.setattr(engine, "renders_arrays", lambda _: False)
    monkeypatch.setattr(
        mosaic.Mosaic, "__init__", lambda *given, **named: original(*given, **named | ON_TORCH)
    )
    names = ("unknown", *(f"class {k}" for k in range(count)))
    network: Any = torch.nn.Conv2d(3, count, 1).eval()
    changes: dict[str, Any] = {"module": network, "class_names": names, "level": LEVEL}
    if count == 1:
        changes |= {"depth_kind": "metric_distance", "class_names": ()}
        torch.nn.init.constant_(network.bias, 9.0)
    trained = trained_network(TANGENT | {"level": LEVEL}, **changes)
    views = ViewSelector(trained, **settings)
    predictor = Predictor(trained, head_of(trained), views, "cpu", 4)
    image = InputImage(sphere(2 ** (LEVEL + 1)))
    predictor.predict(image).pixels()  # fills the cache of tables
    operations = Operations()
    with operations.outside(network):
        predictor.predict(image).pixels()
    return operations


ON_TORCH = {"backend": "torch"}


@pytest.mark.parametrize("count", [1, 150])
@pytest.mark.parametrize("blend", ["nearest", "feather"])
@pytest.mark.parametrize("views", [HORIZONTAL, TANGENT_20], ids=["16 horizontal", "20 tangent"])
def test_a_panorama_takes_at_most_60_operations(
    views: dict[str, Any], blend: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    operations = _operations(monkeypatch, count, views=views, blend=blend)
    assert operations.counts.total() <= 60
    if count == 150:
        assert operations.nbytes <= 1.1 * 4 * (operations.outputs + operations.images)


def test_the_number_of_views_and_classes_does_not_change_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Except for one operation on the outputs of each call: 16 views are four, 20 are five."""
    counts = [
        _operations(monkeypatch, classes, views=views).counts.total()
        for classes in (13, 150)
        for views in (HORIZONTAL, TANGENT_20)
    ]
    assert counts == [counts[0], counts[0] + 1] * 2
