"""Signals on the vertices or faces of an icosphere as a representation.

A signal with V values is an image of one row and V columns, so that networks, losses and data sets
need no other shapes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import check_choice
from tangent_train.geometry import (
    equirect_directions,
    equirect_shape,
    icosphere,
    lonlat_to_equirect,
    panorama_rows,
    random_rotation,
    rotation_about,
    to_right_handed,
    xyz_to_lonlat,
)
from tangent_train.geometry.icosphere import (
    IcosphereElements,
    faces_of_vertices,
    icosphere_count,
    icosphere_directions,
    locate,
    nearest_vertices,
    sampling_points,
)
from tangent_train.rendering.forward import Blend, check_panorama
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import unless_identity, vertical_rotations
from tangent_train.rendering.representations.views import RotationAugmentation, Views
from tangent_train.rendering.resampling import Interpolation, Pixels, resize
from tangent_train.rendering.tables import Value, cached
from tangent_train.rendering.tensors import sample_tensor

ScoreInterpolation = Literal["barycentric", "nearest"]

_SYMMETRY_DEG = 72.0
"""Rotation about the vertical after which an icosphere is the same."""

_CHUNK = 2**18
"""Number of points that are sampled at once."""


@dataclass(frozen=True, eq=False)
class IcosphereViews(Views):
    """A signal on an icosphere, one view.

    Attributes:
        level: Level s of the icosphere.
        elements: The signal has a value at every vertex or on every face.
        matrix: ``(3, 3)`` rotation, or reflection, from directions of the icosphere to directions
            of the panorama; None for the identity.
        interpolation: Interpolation of scores to the panorama.
    """

    level: int
    elements: IcosphereElements
    matrix: NDArray[np.float64] | None = None
    interpolation: ScoreInterpolation = "barycentric"
    is_overlapping = False

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """Render the signal, with the dtype of the image.

        ``bilinear`` averages over the cell of each vertex or face, see `sampling_points`; an image
        of more rows than the level has is reduced first. ``nearest`` takes the pixel at the
        direction of each vertex or face.

        Args:
            image: An array ``(H, W[, C])``, or a tensor ``(C, H, W)``.
            interpolation: ``bilinear`` or ``nearest``.

        Returns:
            An array ``(1, 1, V[, C])``, or a tensor ``(1, C, 1, V)``.
        """
        check_panorama(image, interpolation)
        rows = image.shape[-2] if isinstance(image, Tensor) else image.shape[0]
        if interpolation == "bilinear" and rows > equirect_shape(self.level)[0]:
            image = resize(image, equirect_shape(self.level), interpolation)
        result: Any
        if isinstance(image, Tensor):
            if interpolation == "bilinear":
                return self._means(image)[None, :, None]
            pixels = torch.from_numpy(self._pixels((image.shape[-2], image.shape[-1])))
            result = image.flatten(-2)[..., pixels.to(image.device)]
            return result[None, ..., None, :]
        height, width, *rest = image.shape
        if interpolation == "nearest":
            result = image.reshape(-1, *rest)[self._pixels((height, width))]
            return result[None, None]
        planes = np.moveaxis(image.reshape(height, width, -1), -1, 0)
        wide = torch.from_numpy(planes.astype(np.promote_types(image.dtype, np.float32)))
        result = self._means(wide).numpy().T
        result = np.rint(result) if image.dtype.kind in "ui" else result
        return result.astype(image.dtype).reshape(1, 1, -1, *rest)

    def on_canvas(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return scores ``(1, K, 1, V)`` interpolated to the canvas, and the canvas as one view."""
        values = scores[0, :, 0]
        if self.elements == "faces" and self.interpolation == "barycentric":
            values = torch.cat([_at_vertices(values, self.level), values], dim=1)
        table = self._table(("scores", self.interpolation), shape, self._score_weights)
        source, weight = (torch.from_numpy(part).to(scores.device) for part in table)
        canvas = _weighted_sums(values, source, weight).reshape(1, -1, *shape)
        box = np.array([[0.0, 0.0, shape[1], shape[0]]])
        return canvas, PhotoCrops(box, shape, is_overlapping=False)

    def _table(
        self,
        key: tuple[Any, ...],
        shape: tuple[int, int],
        build: Callable[[tuple[int, int]], Value],
    ) -> Value:
        """Return a cached table of this view and a panorama of some shape."""
        matrix = None if self.matrix is None else self.matrix.tobytes()
        key = "icosphere", self.level, self.elements, matrix, *key, shape
        return cached(key, lambda: build(shape), is_rotated=matrix is not None)

    def _positions(
        self, directions: NDArray[np.floating], shape: tuple[int, int]
    ) -> NDArray[np.float64]:
        """Return columns and rows ``(2, P)`` in a panorama of directions of the icosphere."""
        rotated = directions if self.matrix is None else directions @ self.matrix.T
        return lonlat_to_equirect(xyz_to_lonlat(rotated), shape).T

    def _pixels(self, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Return the pixel ``(V,)`` at the direction of each vertex or face."""

        def build(shape: tuple[int, int]) -> tuple[NDArray[np.int64]]:
            positions = self._positions(icosphere_directions(self.level, self.elements), shape)
            u, v = np.rint(positions).astype(np.int64)
            return (v.clip(0, shape[0] - 1) * shape[1] + u % shape[1],)

        return self._table(("pixels",), shape, build)[0]

    def _points(self, shape: tuple[int, int]) -> tuple[NDArray[np.float32]]:
        """Return columns and rows ``(2, P)`` of the sampling points in a panorama."""
        points = sampling_points(self.level, self.elements)[0]
        positions = np.empty((2, len(points)), np.float32)
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            positions[:, part] = self._positions(points[part].astype(np.float64), shape)
        return (positions,)

    def _means(self, image: Tensor) -> Tensor:
        """Return means ``(C, V)`` of an image ``(C, H, W)`` over cells, differentiable."""
        shape = image.shape[-2], image.shape[-1]
        positions = self._table(("points",), shape, self._points)[0]
        parts = []
        for start in range(0, positions.shape[1], _CHUNK):
            u, v = torch.from_numpy(positions[:, start : start + _CHUNK]).to(image.device)
            parts.append(sample_tensor(image, u, v))
        _, *tables = sampling_points(self.level, self.elements)
        source, weight = (torch.from_numpy(part).to(image.device) for part in tables)
        return _weighted_sums(torch.cat(parts, dim=1), source, weight)

    def _score_weights(
        self, shape: tuple[int, int]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return sources and weights ``(T, H W)`` of the scores at each pixel of a canvas."""
        directions = equirect_directions(shape).reshape(-1, 3)
        if self.matrix is not None:
            directions = directions @ self.matrix
        if self.interpolation == "nearest" and self.elements == "vertices":
            sources = nearest_vertices(self.level, directions)[None]
            return sources, np.ones(sources.shape, np.float32)
        found, weights = locate(self.level, directions)
        if self.interpolation == "nearest":
            return found[None], np.ones((1, len(found)), np.float32)
        sources = icosphere(self.level).faces[found]
        if self.elements == "faces":
            # Linear between the middle of the face and its vertices, which have means of faces.
            least = weights.min(axis=1, keepdims=True)
            sources = np.column_stack([sources, found + icosphere_count(self.level)])
            weights = np.column_stack([weights - least, 3 * least])
        return np.ascontiguousarray(sources.T), weights.T.astype(np.float32)


def _at_vertices(values: Tensor, level: int) -> Tensor:
    """Return the mean ``(K, V)`` of values ``(K, F)`` of the faces around each vertex."""
    around = torch.tensor(faces_of_vertices(level).T).to(values.device)
    is_face = around >= 0
    weight = is_face / is_face.sum(dim=0).to(values.dtype)
    return _weighted_sums(values, around.clamp(min=0), weight)


def _weighted_sums(values: Tensor, source: Tensor, weight: Tensor) -> Tensor:
    """Return ``(K, P)`` sums of values ``(K, V)``, given sources and weights ``(T, P)``."""
    # gather, not index_select: its gradient is ten times faster on a CPU.
    size, total = (len(values), source.shape[1]), torch.zeros((), device=values.device)
    for index, share in zip(source, weight, strict=True):
        total = total + values.gather(1, index.expand(size)) * share
    return total.to(values.dtype)


class IcosphereRepresentation:
    """A signal on the vertices or faces of an icosphere, for networks on its mesh.

    The view is always the whole sphere.

    Args:
        level: Level s of the panorama and of the icosphere.
        elements: The signal has a value at every vertex, 10·4^s + 2, or on every face, 20·4^s.
        random_rotation: Rotation of the icosphere in training.
        mirror: True to mirror half of the training samples left to right.
        interpolation: Interpolation of the network's scores to the panorama: ``barycentric`` is
            linear in the triangle around a pixel; ``nearest`` takes the nearest vertex, or the face
            that contains the pixel.
        erp_height: Rows of the panorama, default `equirect_shape(level)`.
        rotations: Number of rotations about the vertical, within 72°, to average over.

    Raises:
        SettingError: A setting is invalid.
    """

    blend: Blend = "nearest"

    def __init__(
        self,
        level: int,
        elements: IcosphereElements = "vertices",
        random_rotation: RotationAugmentation = "none",
        mirror: bool = False,
        interpolation: ScoreInterpolation = "barycentric",
        erp_height: int | None = None,
        rotations: int = 1,
    ) -> None:
        check_choice("representation.elements", elements, ("vertices", "faces"))
        choices = ("none", "yaw", "so3")
        check_choice("representation.random_rotation", random_rotation, choices)
        check_choice("representation.interpolation", interpolation, ("barycentric", "nearest"))
        self.level, self.elements = level, elements
        self.random_rotation = random_rotation
        self.mirror = mirror
        self.interpolation = interpolation
        self.erp_height = panorama_rows(level, erp_height)
        self._rotations = vertical_rotations(rotations, _SYMMETRY_DEG)
        self._rotation: NDArray[np.float64] = np.eye(3)

    @property
    def image_size(self) -> tuple[int, int]:
        """One row, and a column for each value of the signal."""
        return 1, icosphere_count(self.level, self.elements)

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """Return the same representation in rotated directions R·d."""
        rotated = copy.copy(self)
        rotated._rotation = rotation
        return rotated

    def sample(
        self, rng: np.random.Generator, valid: NDArray[np.bool_] | None = None
    ) -> IcosphereViews:
        """Return the signal, optionally rotated and mirrored; it always covers the sphere."""
        del valid
        matrix = self._rotation
        if self.random_rotation == "so3":
            matrix = matrix @ random_rotation(rng)
        elif self.random_rotation == "yaw":
            matrix = matrix @ rotation_about((0, 0, 1), rng.uniform(0, 2 * np.pi))
        if self.mirror and rng.random() < 0.5:
            matrix = to_right_handed(matrix)
        return self._views(matrix)

    def view_sets(self, valid: NDArray[np.bool_] | None = None) -> list[IcosphereViews]:
        """Return the signal in every rotation about the vertical."""
        del valid
        return [self._views(self._rotation @ rotation) for rotation in self._rotations]

    def _views(self, matrix: NDArray[np.float64]) -> IcosphereViews:
        return IcosphereViews(
            self.level, self.elements, unless_identity(matrix), self.interpolation
        )
