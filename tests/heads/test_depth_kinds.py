"""Outputs of depth networks as distances along the rays."""

from __future__ import annotations

import math
from typing import Any, get_args

import pytest
import torch

from tangent_train.errors import SettingError
from tangent_train.geometry import camera_matrix_from_fov, ray_lengths
from tangent_train.heads.alignment import (
    along_rays,
    depth_of_output,
    distance_of,
    from_distance,
    is_disparity,
)
from tangent_train.kinds import DepthKind, depth_channels


@pytest.mark.parametrize("kind", [kind for kind in get_args(DepthKind) if "points" not in kind])
def test_outputs_of_every_kind_are_distances_along_the_rays(kind: DepthKind) -> None:
    """A plane 2 m in front of a camera of 90°: its z-depth is 2 m everywhere."""
    lengths = torch.from_numpy(ray_lengths(camera_matrix_from_fov(90, (6, 8)), (6, 8)))[None, None]
    distance = 2 * lengths
    output = from_distance(distance, kind, lengths)
    expected: Any = {
        "log_distance": distance.log(),
        "metric_distance": distance,
        "metric_z": 2,
        "canonical_z": 2 * 2,  # the image is 2 m wide at 1 m
        "canonical_inverse": 1 / (2 * 2),
        "relative_z": 2,
        "relative_depth": 2,
        "relative_disparity": 1 / 2,
    }
    torch.testing.assert_close(output, 0 * distance + expected[kind])
    depth, depth_kind = depth_of_output(output, kind, lengths)
    values = along_rays(depth, depth_kind, lengths)
    blended = 1 / distance if is_disparity(depth_kind) else distance.log()
    torch.testing.assert_close(values, blended)
    torch.testing.assert_close(distance_of(values, depth_kind), distance)


def test_canonical_depth_is_multiplied_by_the_focal_length_in_widths() -> None:
    """For wide views, narrow mirrored crops beside the axis, and equirectangular images."""
    inverse = torch.linspace(0.1, 2, 96, dtype=torch.float64).reshape(2, 1, 6, 8)
    for fov_deg, shift, columns in ((90, 0.0, 8), (10, 0.4, 8), (10, 0.4, 7)):
        pitch, of_part = 2 * math.tan(math.radians(fov_deg) / 2) / columns, inverse[..., :columns]
        x = (torch.arange(columns) - (columns - 1) / 2) * pitch + shift
        y = (torch.arange(6) - 2.5) * pitch
        lengths = (1 + x**2 + y[:, None] ** 2).sqrt()[None, None].float().flip(-1)
        found, kind = depth_of_output(of_part, "canonical_inverse", lengths)
        assert kind == "metric_z"
        torch.testing.assert_close(found, 1 / (of_part * columns * pitch), rtol=1e-4, atol=0)
        torch.testing.assert_close(
            from_distance(found * lengths, "canonical_inverse", lengths), of_part
        )
    whole, _ = depth_of_output(inverse, "canonical_inverse", torch.ones(1, 1, 1, 1))
    torch.testing.assert_close(whole, 1 / (inverse * 2 * math.pi))


def test_values_without_a_distance_are_unknown() -> None:
    """Not finite or not positive; the sky has disparity 0. Depth Pro's are limited."""
    odd, one = torch.tensor([torch.nan, torch.inf, -torch.inf, 0.0, -1.0]), torch.ones(1)
    known = {"log_distance": [0, 0, 0, 1, 1], "canonical_inverse": [0, 0, 0, 1, 1]}
    for kind in get_args(DepthKind):
        output = odd.expand(1, depth_channels(kind), 1, 5)
        depth, depth_kind = depth_of_output(output, kind, one)
        found = distance_of(along_rays(depth, depth_kind, one), depth_kind)
        assert found.isfinite().flatten().tolist() == known.get(kind, [0] * 5)


def test_points_of_a_known_camera_have_one_shift_of_z() -> None:
    """Two views of a slanted plane, in units of their own; their z is shifted, a corner unknown."""
    size = 6, 8
    camera = camera_matrix_from_fov(80, size)
    lengths = torch.from_numpy(ray_lengths(camera, size))[None, None]
    rows, columns = torch.meshgrid(torch.arange(6.0), torch.arange(8.0), indexing="ij")
    x, y = (columns - 3.5) / camera[0, 0], (rows - 2.5) / camera[1, 1]
    z = 2 / (1 + 0.3 * x - 0.2 * y)
    points = torch.stack([x * z, y * z, z]).double()
    scales = torch.tensor([[1.0], [3.0]]).double()
    shifts = torch.tensor([[0.5], [-1.5]]).double()
    output = scales[..., None, None] * points
    output[:, 2] -= shifts[..., None]
    output[1, :, :2, :2] = torch.nan
    found, kind = depth_of_output(output, "relative_points", lengths)
    assert kind == "relative_z"
    torch.testing.assert_close(found[0, 0], z.double())
    torch.testing.assert_close(found[1, 0, 2:], 3 * z[2:].double())
    assert found[1, 0, :2, :2].isnan().all()
    with pytest.raises(SettingError, match="one value per pixel, to train it"):
        from_distance(output, "relative_points", lengths)
