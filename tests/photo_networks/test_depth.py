"""Depth networks of transformers and of files: the kind of their output, and their values."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tangent_train.checkpoints.loaded import read_description
from tangent_train.errors import DataError, SettingError
from tangent_train.heads.alignment import depth_of_output
from tangent_train.kinds import DepthKind
from tangent_train.photo_networks import huggingface, import_network
from tangent_train.photo_networks.huggingface import declared_kind
from tests.photo_networks import depth_networks as depth
from tests.photo_networks.huggingface_networks import change_json, imported, saved

CONFIG = Path("config.json")
METRIC = {"model_type": "depth_anything", "depth_estimation_type": "metric"}


def check_equal(found: Tensor, expected: Tensor) -> None:
    """Values are equal up to 1e-5 of their range, and the range is not empty."""
    span = float(expected.max() - expected.min())
    assert span > 1e-2 * float(expected.abs().max())
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5 * span)


def check_family(
    folder: Path, make: Callable[[], Any], side: int, given: DepthKind | None, kind: DepthKind
) -> None:
    """An imported network returns the depth of the library's pipeline, also from its checkpoint."""
    fov_deg = 70.0 if kind == "canonical_inverse" else None
    saved(make, folder, noise=0.1 if fov_deg else 0.2)
    image = depth.photo(side)
    expected = depth.own_depth(folder, image, fov_deg)
    network = huggingface.load(model=str(folder), classes=None, normalization=None, depth=given)
    trained = import_network(network, folder / "imported.ckpt")
    assert (network.depth_kind, trained.depth_kind, trained.class_names) == (kind, kind, ())
    for found in (depth.depth_of(network, image), depth.depth_of(trained, image)):
        if fov_deg is not None:
            x = (torch.arange(side) - (side - 1) / 2) * 2 * math.tan(math.radians(fov_deg) / 2)
            lengths = (1 + (x / side) ** 2 + (x[:, None] / side) ** 2).sqrt()[None, None]
            found = depth_of_output(found[None, None], kind, lengths)[0][0, 0]  # noqa: PLW2901
        check_equal(found, expected)
    described = read_description(folder / "imported.ckpt")
    assert described is not None
    assert described.depth_kind == kind
    assert (described.settings or {})["_target_"] == "models.HuggingFaceDepthNetwork"


@pytest.mark.parametrize("family", [depth.FAMILIES[0], depth.FAMILIES[4]])
def test_depth_is_that_of_the_library(family: Any, tmp_path: Path) -> None:
    """Depth Anything, and ZoeDepth with its padding; tests/slow has all families."""
    check_family(tmp_path, *family)


@pytest.mark.parametrize(
    ("config", "given", "expected"),
    [
        ({"model_type": "depth_anything"}, None, "relative_disparity"),
        (METRIC, None, "metric_z"),
        ({"model_type": "zoedepth"}, "metric_distance", "metric_distance"),
        ({"model_type": "depth_pro"}, None, "canonical_inverse"),
        (METRIC, "relative_disparity", "expected metric_z or metric_distance, because config.json"),
        ({"model_type": "depth_pro"}, "metric_z", "expected canonical_inverse, because config.js"),
        ({"model_type": "dpt"}, None, "depth: found none; expected log_dis.* Set depth=, e.g. rel"),
    ],
)
def test_the_config_determines_the_kind(config: Any, given: Any, expected: str) -> None:
    if " " not in expected:
        assert declared_kind(config, CONFIG, given) == expected
        return
    with pytest.raises((DataError, SettingError), match=expected):
        declared_kind(config, CONFIG, given)


def test_the_architecture_decides_if_transformers_has_both(tmp_path: Path) -> None:
    saved(depth.dpt, tmp_path)

    def kind(given: DepthKind | None, architecture: str) -> DepthKind | None:
        change_json(tmp_path / "config.json", architectures=[architecture])
        load = huggingface.load
        return load(model=str(tmp_path), classes=None, normalization=None, depth=given).depth_kind

    assert kind("metric_z", "DPTForDepthEstimation") == "metric_z"
    assert kind("metric_z", "DPTForDensePrediction") == "metric_z"
    with pytest.raises(DataError, match=r"architectures: DPTForDensePrediction; .*Set depth="):
        kind(None, "DPTForDensePrediction")
    with pytest.raises(DataError, match="expected id2label with the name of every score"):
        kind(None, "DPTForSemanticSegmentation")


def test_a_config_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    saved(depth.depth_anything, tmp_path)
    change_json(tmp_path / "config.json", depth_estimation_type="squared")
    with pytest.raises(DataError, match=r"config\.json: found network cannot be built"):
        imported(tmp_path, depth="relative_disparity")


def test_depth_pro_takes_images_of_one_size(tmp_path: Path) -> None:
    saved(depth.depth_pro, tmp_path)
    trained = imported(tmp_path)
    assert trained.fixed_size == trained.image_size == (64, 64)
    assert "fov_model" not in json.dumps([*trained.module.state_dict()])
