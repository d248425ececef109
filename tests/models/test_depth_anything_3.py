"""Depth Anything 3: its cameras, with a stand-in; its networks, if the package is installed."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from models import DepthAnything3
from tests.inference.test_many_views import (
    Ball,
    many_view_network,
    predicted,
    true_distances,
)


class StandIn(Ball):
    """Sees the ball-shaped room in the axes of its first camera, in the package's conventions."""

    first: Tensor

    def forward(self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor) -> Any:
        camera_from_world, matrix = extrinsics[0, :, :3, :3], intrinsics[0].clone()
        assert torch.equal(extrinsics[0, :, :3, 3], torch.zeros(len(matrix), 3))
        torch.testing.assert_close(camera_from_world[0], torch.eye(3))
        assert tuple(matrix[0, :2, 2] * 2) == (images.shape[-1], images.shape[-2])
        matrix[:, :2, 2] -= 0.5
        found = super().forward(images[0], self.first @ camera_from_world.mT, matrix)
        depth = found["out"][None]
        return {"depth": depth, "depth_conf": depth + 1, "extrinsics": extrinsics[:, :, :3]}


def test_cameras_are_those_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    config = {"create_object": StandIn, "load_config": lambda preset: preset}
    for name, content in (
        ("cfg", config),
        ("registry", {"MODEL_REGISTRY": {"da3-small": "right"}}),
        ("utils.logger", {"logger": SimpleNamespace(level=2)}),
    ):
        monkeypatch.setitem(sys.modules, f"depth_anything_3.{name}", SimpleNamespace(**content))
    for name in ("depth_anything_3", "depth_anything_3.utils"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__path__=[]))
    network = DepthAnything3("da3-small")
    network.size_multiple = 1
    network.register_forward_pre_hook(
        lambda _, inputs: setattr(network.model, "first", inputs[1][0])
    )
    mosaic = predicted(replace(many_view_network(network), depth_kind="relative_z"))
    ratio = mosaic.pixels().numpy() / true_distances()
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=1e-4)
    assert float(mosaic.facts["rotation_error_deg"]) < 1e-2
