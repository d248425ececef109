"""Depth networks of all families of transformers, from a saved folder to exported files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tangent_train as tt
from models.huggingface import DEPTH, network_types
from tangent_train.errors import SettingError
from tangent_train.inference.export import export_network
from tangent_train.photo_networks import huggingface, import_network
from tests.photo_networks import depth_networks as depth
from tests.photo_networks.huggingface_networks import saved
from tests.photo_networks.test_depth import check_family

each_family = pytest.mark.parametrize("family", depth.FAMILIES, ids=lambda one: one[0].__name__)


@each_family
def test_depth_is_that_of_the_library(family: Any, tmp_path: Path) -> None:
    check_family(tmp_path, *family)


def test_all_families_are_tried_or_refused() -> None:
    tried = {make()[0].config.model_type for make, *_ in depth.FAMILIES}
    refused = {name for name, kinds in huggingface._FAMILIES.items() if not kinds}
    assert tried | refused == network_types(DEPTH)


@each_family
def test_depth_of_a_panorama_is_that_of_the_exported_network(family: Any, tmp_path: Path) -> None:
    """With a scale per view: shifts of random networks make disparities cross 0."""
    make, side, given, kind = family
    saved(make, tmp_path)
    network = huggingface.load(model=str(tmp_path), classes=None, normalization=None, depth=given)
    path = tmp_path / "net.ckpt"
    trained = import_network(network, path, image_size=(side, side), views="horizontal_economy")
    panorama = np.concatenate([depth.photo(64), depth.photo(64)[:, ::-1]], axis=1)
    expected = tt.load(path, align="scale").depth(panorama)
    assert expected.shape == (64, 128)
    assert np.isfinite(expected).mean() > 0.5
    assert np.nanstd(np.log(expected)) > 1e-4
    for name in ("net.safetensors", "net.onnx"):
        if name == "net.onnx" and make in _NOT_ONNX:
            with pytest.raises(SettingError, match="safetensors file takes every network"):
                export_network(trained, tmp_path / name)
            continue
        export_network(trained, tmp_path / name)
        again = tt.load(tmp_path / name, align="scale")
        assert again.loaded.depth_kind == kind
        found, near = again.depth(panorama), np.nanmax(1 / expected)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
        np.testing.assert_allclose(1 / found, 1 / expected, rtol=1e-3, atol=1e-4 * near)


_NOT_ONNX = (depth.zoedepth, depth.zoedepth_of_two)
"""Networks that torch's exporter does not support."""


def test_a_graph_that_the_exporter_specializes_is_for_one_size(tmp_path: Path) -> None:
    """The size of the training, although the network takes others."""
    saved(depth.depth_anything, tmp_path)
    network = huggingface.load(model=str(tmp_path), classes=None, normalization=None)
    trained = import_network(network, tmp_path / "net.ckpt")
    assert (trained.size_multiple, trained.fixed_size) == (14, None)
    assert export_network(trained, tmp_path / "net.onnx").loaded.fixed_size == (70, 70)
