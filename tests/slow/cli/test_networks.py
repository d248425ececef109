"""Every network of the config tree takes the data it is for, and what `build` fills in for it."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tangent_train.cli.build import build
from tangent_train.cli.compose import config_folder
from tests.running import composed_settings

NETWORKS = {path.stem for path in (config_folder() / "network").glob("*.yaml")}
OF_SHAPES = {"multi_view_resnet18", "shape_classifier", "shape_classifier_16"}
DEPTH = {"fcn_resnet": "network.depth=50", "fcn_resnet_context": "network.network.depth=50"}


def _composed(*overrides: str) -> dict[str, Any]:
    return composed_settings("train", "level=5", "representation.erp_height=32", *overrides)


@pytest.mark.parametrize("network", sorted(NETWORKS - OF_SHAPES))
def test_every_network_takes_the_data_s_channels_and_classes(network: str) -> None:
    shallow = [DEPTH[network]] if network in DEPTH else []
    for inputs, channels in (("[rgb]", 3), ("[rgb,depth]", 4)):
        _, task = build(_composed(f"network={network}", f"data.inputs={inputs}", *shallow))
        scores = task(torch.randn(2, channels, 32, 32))
        assert scores.shape == (2, 13, 32, 32)
    outputs = task.outputs(torch.randn(2, channels, 32, 32)).values()
    sum(output.square().mean() for output in outputs).backward()
    unused = [n for n, p in task.named_parameters() if p.grad is None and ".mixer." not in n]
    assert not unused, "parameters without gradient"


SHAPES = ("data=modelnet40", "data.root=nowhere", "task=classification")


@pytest.mark.parametrize("network", sorted(OF_SHAPES))
def test_every_network_of_shapes_takes_their_channels_and_classes(network: str) -> None:
    data, task = build(_composed(*SHAPES, f"network={network}"))
    assert len(data.class_names) == 40
    scores = task(torch.randn(2, 3, 6, 32, 32))
    assert scores.shape == (2, 40)
    scores.square().mean().backward()
    unused = [n for n, p in task.named_parameters() if p.grad is None and ".mixer." not in n]
    assert not unused, "parameters without gradient"


class Recorder(torch.nn.Conv2d):
    """A network that remembers its settings."""

    def __init__(self, in_channels: int, classes: int, **settings: Any) -> None:
        super().__init__(in_channels, classes, 1)
        self.settings = settings


@pytest.mark.parametrize("source", [{}, {"checkpoint": "x"}, {"resume": "x"}])
def test_published_weights_are_left_out_where_a_checkpoint_has_others(
    source: dict[str, str],
) -> None:
    settings = _composed() | source
    target = f"{__name__}.Recorder"
    settings["network"] = {
        "_target_": target,
        "in_channels": None,
        "classes": None,
        "weights": "coco",
    }
    _, task = build(settings)
    assert task.network.in_channels == 4
    assert task.network.settings == {"weights": None if source else "coco"}
