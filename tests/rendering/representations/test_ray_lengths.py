"""Lengths of rays equal the distance of a plane at z-depth 1, in all kinds of views."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tangent_train.config.build import build_from_config
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector, view_settings
from tangent_train.rendering import (
    CubemapRepresentation,
    PerspectiveRepresentation,
    TangentRepresentation,
)
from tests.inference.trained import TANGENT, trained_network

RING = view_settings("horizontal") | {"level": 5}


@pytest.mark.parametrize(
    "representation",
    [
        TangentRepresentation(0, 4, crop_multiple=3),
        CubemapRepresentation(4, margin=2),
        build_from_config(RING, "representation"),
    ],
    ids=["tangent", "cube", "horizontal"],
)
def test_lengths_are_those_of_the_rays(representation: Any) -> None:
    views = representation.view_sets()[0]
    rows, columns = views.grid.size
    x, y = ((2 * np.arange(n) + 1) / n - 1 for n in (columns, rows))
    x, y = np.meshgrid(x, y)
    for some in (views, replace(views[1:3], mirrored=True)):
        directions = np.einsum("nwc,ijc->nijw", some.rays(), np.stack([x, y, 0 * x + 1], axis=-1))
        found = np.broadcast_to(some.ray_lengths(), directions.shape[:-1])
        np.testing.assert_allclose(found, np.linalg.norm(directions, axis=-1), rtol=2e-6)


def _lengths(matrix: Any, box: Any, size: tuple[int, int]) -> Any:
    """Compute the lengths of the rays of a crop of a photo, pixel by pixel."""
    lengths = np.empty(size)
    for i, j in np.ndindex(size):
        u = box[0] + (j + 0.5) * (box[2] - box[0]) / size[1] - 0.5
        v = box[1] + (i + 0.5) * (box[3] - box[1]) / size[0] - 0.5
        lengths[i, j] = np.linalg.norm(np.linalg.inv(matrix) @ (u, v, 1))
    return lengths


def test_lengths_in_crops_are_those_of_the_photo() -> None:
    """Pixels that are not square, and a principal point that is not in the middle."""
    matrix = np.array([[50.0, 0, 21], [0, 60, 40], [0, 0, 1]])
    common = PerspectiveRepresentation(6, 30, (8, 12), crops_per_photo=3)
    crops = common.of_camera(matrix, (50, 80)).sample(np.random.default_rng(0))
    expected = np.stack([_lengths(matrix, box, crops.size) for box in crops.boxes])
    assert np.ptp(expected[:, 0, 0]) > 0.01
    np.testing.assert_allclose(crops.ray_lengths(), expected, rtol=1e-6)
    np.testing.assert_allclose(crops[1:2].ray_lengths(), expected[1:2], rtol=1e-6)
    mirrored = replace(crops, mirrored=True).ray_lengths()
    np.testing.assert_allclose(mirrored, expected[:, :, ::-1], rtol=1e-6)


def test_resized_and_mirrored_photos_keep_their_camera() -> None:
    matrix = np.array([[30.0, 0, 11], [0, 35, 27], [0, 0, 1]])
    photo = InputImage(np.zeros((30, 41, 3), np.uint8), camera_matrix=matrix)
    for scale in (1, 20):  # the photo is smaller than a crop; and reduced first
        large = photo
        if scale > 1:
            camera = np.diag([scale, scale, 1]) @ matrix
            camera[:2, 2] += (scale - 1) / 2
            large = InputImage(
                np.zeros((30 * scale, 41 * scale, 3), np.uint8), camera_matrix=camera
            )
        (source,) = ViewSelector(trained_network(TANGENT))(large)
        (crops,) = source.sets
        boxes: Any = crops.canvas_boxes  # type: ignore[attr-defined]
        expected = [_lengths(large.camera_matrix, box, crops.size) for box in boxes]  # type: ignore[attr-defined]
        np.testing.assert_allclose(crops.ray_lengths(), expected, rtol=1e-6)
