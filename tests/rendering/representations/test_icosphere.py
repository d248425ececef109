"""Signals on icospheres: rendered from panoramas, rotated, and placed on the canvas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.geometry import (
    equirect_directions,
    icosphere,
    random_rotation,
    rotation_about,
)
from tangent_train.geometry.icosphere import (
    IcosphereElements,
    icosphere_count,
    icosphere_directions,
)
from tangent_train.rendering import IcosphereRepresentation
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.icosphere import IcosphereViews, ScoreInterpolation

ELEMENTS: list[IcosphereElements] = ["vertices", "faces"]
both_elements = pytest.mark.parametrize("elements", ELEMENTS)


def smooth(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a function ``(..., 2)`` of directions that no rotation or mirror leaves unchanged."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack([x * y + 0.5 * z, np.sin(2 * z + x) * y], axis=-1)


def mean_reference(
    image: NDArray[np.float64], views: IcosphereViews, cells: list[int]
) -> NDArray[np.float64]:
    """Integrate an image over cells: slow, in float64, over 105 points of each of their triangles.

    The spherical triangle between a vertex, the middle of an edge and the middle of the face is
    divided evenly; points weigh by solid angle. Bilinear interpolation is by hand.
    """
    height, width = image.shape[:2]
    vertices, faces = icosphere_directions(views.level), icosphere(views.level).faces
    fine = [((i + 1 / 3) / 14, (j + 1 / 3) / 14) for i in range(14) for j in range(14 - i)]
    means = []
    for cell in cells:
        total, weight = np.zeros(image.shape[2:]), 0.0
        for face, corner in [
            (f, c)
            for f in ([cell] if views.elements == "faces" else range(len(faces)))
            for c in range(3)
            if views.elements == "faces" or faces[f, c] == cell
        ]:
            a = vertices[faces[face, corner]]
            center = vertices[faces[face]].mean(axis=0)
            for other in (1, 2):
                middle = (a + vertices[faces[face, (corner + other) % 3]]) / 2
                for s, t in fine:
                    point = a + s * (middle - a) + t * (center - a)
                    share = 1 / np.linalg.norm(point) ** 3
                    share *= abs(np.linalg.det([a, middle, center]))
                    x, y, z = point if views.matrix is None else views.matrix @ point
                    u = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * width - 0.5
                    v = (0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * height - 0.5
                    left, top = int(np.floor(u)), int(np.floor(v))
                    for row, down in ((top, 1 - v + top), (top + 1, v - top)):
                        beyond = row < 0 or row >= height
                        inside = min(max(row, 0), height - 1)
                        for column, across in ((left, 1 - u + left), (left + 1, u - left)):
                            at = (column + (width // 2 if beyond else 0)) % width
                            total += share * down * across * image[inside, at]
                    weight += share
        means.append(total / weight)
    return np.array(means)


@both_elements
@pytest.mark.parametrize("seed", [None, 0])
def test_colors_are_means_over_cells(elements: IcosphereElements, seed: int | None) -> None:
    image = np.random.default_rng(5).uniform(0, 255, (8, 16, 3))
    matrix = None if seed is None else random_rotation(np.random.default_rng(seed))
    views = IcosphereViews(2, elements, matrix)
    cells = [0, 11, 5, 100]  # both poles and a corner among the vertices
    expected = mean_reference(image, views, cells)
    for dtype in (np.float64, np.float32, np.uint8):
        rendered = views.render(image.astype(dtype), "bilinear")
        assert rendered.dtype == dtype
        assert rendered.shape == (1, 1, icosphere_count(2, elements), 3)
        error = rendered[0, 0, cells] - expected
        assert np.sqrt((error**2).mean()) < 0.2 * expected.std(), "of noise, with few points"
    exact = views.render(image, "bilinear")[0, 0]
    tensor = views.render(torch.from_numpy(image).movedim(-1, 0), "bilinear")
    np.testing.assert_allclose(tensor[0, :, 0].T, exact, atol=2e-4)
    fine = views.render(image.repeat(4, 0).repeat(4, 1), "bilinear")[0, 0]
    np.testing.assert_allclose(fine, exact, err_msg="a finer panorama is reduced first")


def test_a_tensor_has_a_gradient_through_the_means() -> None:
    views = IcosphereViews(1, "vertices", random_rotation(np.random.default_rng(2)))
    image = torch.rand(1, 4, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: views.render(x, "bilinear"), image)


@both_elements
def test_samples_are_the_panorama_in_rotated_directions(elements: IcosphereElements) -> None:
    shape = 64, 128
    pixels = np.arange(shape[0] * shape[1], dtype=np.int32).reshape(shape)
    image = smooth(equirect_directions((16, 32)))
    tilt = rotation_about((1, 2, 0), 0.4)
    kinds: tuple[Any, ...] = ("none", "yaw", "so3")
    seen = set()
    for kind in kinds:
        for seed in range(4):
            fixed = IcosphereRepresentation(3, elements, kind, mirror=True).with_rotation(tilt)
            views = fixed.sample(np.random.default_rng(seed))
            matrix = np.eye(3) if views.matrix is None else views.matrix
            inner = tilt.T @ matrix
            mirrored = bool(np.linalg.det(inner) < 0)
            inner = inner @ np.diag([1, -1, 1]) if mirrored else inner
            np.testing.assert_allclose(inner @ inner.T, np.eye(3), atol=1e-14)
            if kind == "none":
                np.testing.assert_allclose(inner, np.eye(3), atol=1e-14)
            if kind == "yaw":
                np.testing.assert_allclose(inner[2], (0, 0, 1), atol=1e-14)
            directions = icosphere_directions(3, elements) @ matrix.T
            # A label is that of the pixel at the direction; colors are means around it.
            nearest = views.render(pixels, "nearest")[0, 0]
            found = equirect_directions(shape).reshape(-1, 3)[nearest]
            assert (np.arccos((found * directions).sum(axis=1).clip(-1, 1)) < 0.036).all()
            colors = views.render(image, "bilinear")[0, 0]
            assert np.abs(colors - smooth(directions)).max() < 0.035
            as_tensor = views.render(torch.from_numpy(pixels)[None], "nearest")
            assert (as_tensor[0, 0, 0].numpy() == nearest).all()
            seen.add((kind, mirrored))
    assert len(seen) == 6


@both_elements
@pytest.mark.parametrize(("interpolation", "most"), [("barycentric", 0.02), ("nearest", 0.16)])
@pytest.mark.parametrize("seed", [None, 3])
def test_round_trip_of_a_smooth_function(
    elements: IcosphereElements, interpolation: ScoreInterpolation, most: float, seed: int | None
) -> None:
    shape = 31, 66  # not the size of a level
    matrix = None if seed is None else random_rotation(np.random.default_rng(seed))
    views = IcosphereViews(4, elements, matrix, interpolation)
    expected = smooth(equirect_directions(shape)).astype(np.float32)
    signal = views.render(expected, "bilinear")[0]
    scores = torch.from_numpy(signal).movedim(-1, 0)[None]
    canvas, placed = views.on_canvas(scores, shape)
    assert len(placed) == 1
    assert np.abs(canvas[0].movedim(0, -1).numpy() - expected).max() < most, "poles and seam too"
    exactly = torch.full_like(scores, 3.5)
    torch.testing.assert_close(views.on_canvas(exactly, shape)[0], torch.full_like(canvas, 3.5))


@pytest.mark.parametrize("backend", ["numba", "torch"])
@both_elements
def test_labels_of_large_cells_come_back_through_a_mosaic(
    elements: IcosphereElements, backend: Any
) -> None:
    shape = 64, 128
    directions = equirect_directions(shape)
    corners = icosphere_directions(0)
    label = (directions @ corners.T).argmax(axis=-1).astype(np.uint8)
    ordered = np.sort(directions @ corners.T, axis=-1)
    inside = np.arccos(ordered[..., -2]) - np.arccos(ordered[..., -1]) > 0.12
    representation = IcosphereRepresentation(5, elements, rotations=2)
    mosaic = ScoreMosaic(shape, 12, "nearest", averaged=True, backend=backend)
    for views in representation.with_rotation(rotation_about((1, 0, 0), 0.3)).view_sets():
        signal = torch.from_numpy(views.render(label, "nearest").astype(np.int64))
        mosaic.add(torch.nn.functional.one_hot(signal[:, 0], 12).movedim(-1, 1)[:, :, None], views)
    labels = mosaic.labels().numpy()
    assert (labels[inside] == label[inside]).all()
    assert (labels == label).mean() > 0.93
