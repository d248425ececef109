"""Mask R-CNN of torchvision: probabilities and objects are those of the library's instances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchvision import models

from tangent_train.photo_networks import import_network
from tangent_train.photo_networks.libraries import load_torchvision

LABELS = ["__background__", "chair", "N/A", "lamp"]
FEW = {"rpn_post_nms_top_n_test": 20, "box_detections_per_img": 12}
"""Settings with which the test is fast."""


@torch.no_grad()
def _saved(name: str, folder: Path, image: Tensor) -> Any:
    """The library's network, which finds objects of all labels, some above the threshold."""
    torch.manual_seed(0)
    sizes = {"min_size": 64, "max_size": 80, "num_classes": len(LABELS)}
    network: Any = models.get_model(name, weights=None, weights_backbone=None, **sizes, **FEW)
    box = network.eval().roi_heads.box_predictor
    features = []
    hook = box.register_forward_hook(lambda _, given, __: features.extend(given))
    network([image])
    hook.remove()
    box.cls_score.weight.mul_(0.7 / (features[0] @ box.cls_score.weight.T).std(0)[:, None])
    mean = (features[0] @ box.cls_score.weight.T).mean(0)
    box.cls_score.bias.copy_(torch.tensor([0, 1, 0.5, 1]) - mean)
    torch.save(network.state_dict(), folder / "state.pt")
    (folder / "classes.json").write_text(json.dumps(LABELS))
    for module in network.modules():
        if name == "maskrcnn_resnet50_fpn" and isinstance(module, nn.BatchNorm2d):
            module.eps = 0.0  # as with published weights
    return network


@torch.no_grad()
@pytest.mark.parametrize("name", ["maskrcnn_resnet50_fpn", "maskrcnn_resnet50_fpn_v2"])
def test_one_view_has_the_instances_of_the_library(name: str, tmp_path: Path) -> None:
    image = torch.rand(3, 64, 80, generator=torch.Generator().manual_seed(1))
    network = _saved(name, tmp_path, image)
    files = str(tmp_path / "state.pt"), tmp_path / "classes.json"
    loaded = load_torchvision(name, *files, threshold=0.45)
    assert loaded.settings is not None
    loaded = replace(loaded, settings=loaded.settings | FEW, image_size=(64, 64))
    trained = import_network(loaded, tmp_path / "net.ckpt")
    assert trained.class_names == ("unknown", "chair", "lamp")
    assert trained.things == ("chair", "lamp")
    returned: Any = trained.module(image[None])
    (shares,), (segments,) = returned["out"], returned["segments"]

    (found,) = network([image])
    labels = found["labels"].tolist()
    expected, front, objects = np.zeros((3, 64, 80)), np.zeros((64, 80)), []
    for k in found["scores"].argsort().tolist():
        if labels[k] == LABELS.index("N/A"):
            continue
        of_class, score = {1: 0, 3: 1}[labels[k]], float(found["scores"][k])
        mask = found["masks"][k, 0].numpy()
        expected[of_class] = np.maximum(expected[of_class], score * mask)
        if score > 0.45:
            objects.append((of_class, score))
            front[mask > 0.5] = len(objects)
    expected[2] = 1 - expected[:2].max(axis=0)
    assert set(labels) == {1, 2, 3}
    assert 0 < len(objects) < len(labels)
    assert (front > 0).any()
    np.testing.assert_allclose(shares, expected, atol=1e-4)
    assert segments.classes.tolist() == [of_class for of_class, _ in objects]
    np.testing.assert_allclose(segments.scores, [score for _, score in objects], atol=1e-4)
    np.testing.assert_array_equal(segments.numbers, front)
    output: Any = trained.network(image[None])
    is_unknown = expected[:2].max(axis=0) < 0.5
    np.testing.assert_array_equal(output["out"][0].argmax(0) == 2, is_unknown)
    assert 0 < is_unknown.mean() < 1
