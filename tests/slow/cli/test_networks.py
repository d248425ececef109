"""Every network of the config tree takes the data it is for, and what `build` fills in for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tangent_train.checkpoints.loaded import load_network
from tangent_train.cli.run import build
from tangent_train.files import config_folder
from tangent_train.inference.export import export_network
from tests.running import composed_settings
from tests.slow.test_prior_methods import NETWORKS as PRIOR_METHODS
from tests.tasks.odd_networks import assert_same, scores_of, some_images
from tests.tasks.small_networks import save_checkpoint

NETWORKS = {path.stem for path in (config_folder() / "network").glob("*.yaml")}
NETWORKS -= {"fcn_resnet_coco"}  # fcn_resnet with weights from the internet
NETWORKS -= {"depth_anything_3"}  # takes all views of a panorama
NETWORKS -= {*PRIOR_METHODS, "zonal_classifier", "spherical_cnn"}
OF_SHAPES = {"shape_classifier", "shape_classifier_16"}
ALIKE = {"unet_small"}
"""Of the same parts as others."""
DEPTH = {"fcn_resnet": "network.depth=50"}


def _composed(*overrides: str) -> Any:
    return composed_settings("train", "level=5", "representation.erp_height=32", *overrides)


SHAPES = ("data=modelnet40", "data.root=nowhere", "task=classification")


@pytest.mark.parametrize("network", sorted(NETWORKS))
def test_every_network_takes_its_data_s_channels_and_classes(network: str) -> None:
    settings = [f"network={network}", *([DEPTH[network]] if network in DEPTH else [])]
    shapes = network in OF_SHAPES
    cases = {6: SHAPES} if shapes else {3: ("data.inputs=[rgb]",), 4: ("data.inputs=[rgb,depth]",)}
    for channels, of_data in cases.items():
        _, task = build(_composed(*of_data, *settings))
        assert len(task.head.class_names) == (40 if shapes else 14)
        images = torch.randn(2, *([3] if shapes else []), channels, 32, 32)
        outputs = {"out": task(images)} if shapes else task(images)
        assert outputs["out"].shape == ((2, 40) if shapes else (2, 13, 32, 32))
    sum(output.square().mean() for output in outputs.values()).backward()
    unused = [n for n, p in task.named_parameters() if p.grad is None]
    assert not unused, "parameters without gradient"


@pytest.mark.parametrize("network", sorted(NETWORKS - OF_SHAPES - ALIKE))
def test_every_kind_of_network_can_be_exported_for_images_of_any_size(
    network: str, tmp_path: Path
) -> None:
    shallow = [DEPTH[network]] if network in DEPTH else []
    level = ["level=5", "representation.erp_height=32"]
    save_checkpoint(tmp_path / "net.ckpt", f"network={network}", *level, *shallow)
    trained = load_network(tmp_path / "net.ckpt")
    path = tmp_path / "net.onnx"
    assert export_network(trained, path).loaded.fixed_size is None
    again, step = load_network(path), trained.size_multiple
    for count, size in ((1, (64, 96)), (5, (32 + step, 64))):
        images = some_images(trained, count, size)
        assert_same(again.network(images).detach(), scores_of(trained, images))
