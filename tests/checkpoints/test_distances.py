"""Outputs of depth networks as distances along the rays."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from torch import Tensor, nn

from datamodules.core.labels import DISTANCE
from tangent_train.checkpoints.content import DepthKind
from tangent_train.checkpoints.distances import (
    DistanceNetwork,
    along_rays,
    distance_of,
    from_distance,
    is_disparity,
    uncanonical,
)
from tangent_train.checkpoints.scores import network_for_views, size_multiple_of
from tangent_train.checkpoints.trained import describe_network, load_trained
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.class_maps import load_class_map, map_classes
from tests.inference.trained import write_checkpoint


@pytest.mark.parametrize("kind", get_args(DepthKind))
def test_outputs_of_every_kind_are_distances_along_the_rays(kind: DepthKind) -> None:
    """A plane 2 m in front of the camera: its z-depth is 2 m, its distance 2 m · ray length."""
    lengths = torch.linspace(1, 3, 12, dtype=torch.float64).reshape(1, 3, 4)
    distance = 2 * lengths
    if kind == "canonical_inverse":
        with pytest.raises(ValueError, match="uncanonical first"):
            along_rays(distance, kind, lengths)
        return
    output = from_distance(distance, kind, lengths)
    expected: Any = {
        "log_distance": distance.log(),
        "metric_distance": distance,
        "metric_z": 2.0 * torch.ones(1, 3, 4),
        "relative_depth": 2.0 * torch.ones(1, 3, 4),
        "relative_disparity": 0.5 * torch.ones(1, 3, 4),
    }
    torch.testing.assert_close(output, expected[kind].double())
    values = along_rays(output, kind, lengths)
    blended = 1 / distance if is_disparity(kind) else distance.log()
    torch.testing.assert_close(values, blended)
    torch.testing.assert_close(distance_of(values, kind), distance)


def test_canonical_depth_is_multiplied_by_the_focal_length_in_widths() -> None:
    """For views of 90°, 10°, mirrored crops beside the axis, and equirectangular images."""
    depth = torch.linspace(0.1, 2, 96, dtype=torch.float64).reshape(2, 1, 6, 8)
    for fov_deg, shift, columns in ((90, 0.0, 8), (10, 0.4, 8), (10, 0.4, 7)):
        pitch = 2 * math.tan(math.radians(fov_deg) / 2) / columns
        x = (torch.arange(columns) - (columns - 1) / 2) * pitch + shift
        y = (torch.arange(6) - 2.5) * pitch
        lengths = (1 + x**2 + y[:, None] ** 2).sqrt()[None, None].float()
        found, kind = uncanonical(depth[..., :columns], "canonical_inverse", lengths.flip(-1))
        assert kind == "metric_z"
        torch.testing.assert_close(
            found, 1 / (depth[..., :columns] * columns * pitch), rtol=1e-4, atol=0
        )
        distance = found * lengths.flip(-1)
        torch.testing.assert_close(
            from_distance(distance, "canonical_inverse", lengths.flip(-1)), depth[..., :columns]
        )
    whole, kind = uncanonical(depth, "canonical_inverse", torch.ones(1, 1, 1, 1))
    torch.testing.assert_close(whole, 1 / (depth * 2 * math.pi))
    assert uncanonical(depth, "relative_depth", lengths) == (depth, "relative_depth")


def test_values_without_a_distance_are_unknown() -> None:
    odd = torch.tensor([torch.nan, torch.inf, -torch.inf, 0.0, -1.0])
    one = torch.ones(1)
    for kind in ("metric_distance", "metric_z", "relative_depth"):
        assert along_rays(odd, kind, one).isnan().all()
    assert along_rays(odd, "log_distance", one).isnan().tolist() == [True] * 3 + [False] * 2
    disparity = along_rays(odd, "relative_disparity", one)
    assert distance_of(disparity, "relative_disparity").isnan().all(), "the sky has disparity 0"


class _MeanColor(nn.Module):
    """Depth is the mean of the channels; only one size is taken if it is given."""

    def __init__(self, size: tuple[int, int] | None = None, output: str = "map") -> None:
        super().__init__()
        self.size, self.output = size, output

    def forward(self, images: Tensor) -> Any:
        if self.size not in (None, tuple(images.shape[-2:])):
            raise ValueError(self.size)
        depth = images.mean(dim=1)
        return {"map": depth, "channel": depth[:, None], "dict": {"out": depth[:, None]}}.get(
            self.output, images
        )


@pytest.mark.parametrize("output", ["map", "channel", "dict"])
def test_outputs_of_several_forms_have_one_channel(output: str) -> None:
    images = torch.randn(2, 3, 4, 6)
    network = DistanceNetwork(_MeanColor(output=output), "metric_z")
    torch.testing.assert_close(network(images), images.mean(dim=1, keepdim=True))
    assert size_multiple_of(network, 3) == 1
    assert network_for_views(network, distortion_aware=False) is network


def test_other_outputs_are_refused() -> None:
    for network in (_MeanColor(output="colors"), nn.AvgPool2d(2)):
        with pytest.raises(SettingError, match=r"depth network: found output \(2, 3, .*one value"):
            DistanceNetwork(network, "metric_z")(torch.zeros(2, 3, 4, 6))


def test_images_are_resized_for_networks_of_one_size() -> None:
    """A plane keeps its depth: no part of the image is predicted separately."""
    network = DistanceNetwork(_MeanColor((4, 6)), "relative_disparity", tile=(4, 6))
    x, y = torch.meshgrid(torch.linspace(-1, 1, 12), torch.linspace(-1, 1, 8), indexing="xy")
    images = (2 + 0.5 * x + y).expand(1, 3, 8, 12)
    found = network(images)
    assert found.shape == (1, 1, 8, 12)
    torch.testing.assert_close(found[..., 1:-1, 1:-1], images[:, :1, 1:-1, 1:-1], atol=0.1, rtol=0)
    assert size_multiple_of(DistanceNetwork(_MeanColor((4, 6)), "metric_z"), 3) is None


def write_depth_checkpoint(path: Path, **changes: Any) -> Path:
    """Write a checkpoint of a depth network: a 3×3 convolution to one channel."""
    write_checkpoint(path)
    content = torch.load(path, weights_only=True)
    content["config"]["network"]["out_channels"] = 1
    content["state_dict"] = {k: v[:1].clone() for k, v in content["state_dict"].items()}
    depth = {"predicts": DISTANCE, "class_names": [], "tangent_train_version": "0"}
    torch.save(content | depth | changes, path)
    return path


@pytest.mark.parametrize("kind", [None, "relative_disparity"])
def test_checkpoints_contain_the_kind_of_depth(kind: DepthKind | None, tmp_path: Path) -> None:
    """The checkpoint of a run contains no kind: it is that of `DepthTask`."""
    changes = {} if kind is None else {"depth_kind": kind}
    path = write_depth_checkpoint(tmp_path / "net.ckpt", **changes)
    trained, described = load_trained(path), describe_network(path)
    assert described is not None
    assert trained.depth_kind == described.depth_kind == (kind or "log_distance")
    assert (trained.predicts, trained.class_names, trained.size_multiple) == (DISTANCE, (), 1)
    assert trained.network(torch.zeros(2, 3, 16, 16)).shape == (2, 1, 16, 16)
    with pytest.raises(SettingError, match=r"found a network that predicts distance.*class_map"):
        map_classes(trained, load_class_map("ade20k_to_stanford2d3ds"), "unknown")


def test_other_kinds_of_depth_are_refused(tmp_path: Path) -> None:
    path = write_depth_checkpoint(tmp_path / "net.ckpt", depth_kind="inverse")
    with pytest.raises(DataError, match="depth_kind='inverse'"):
        load_trained(path)
    path = write_checkpoint(tmp_path / "classes.ckpt")
    assert load_trained(path).depth_kind is None
