"""Representations of panoramas: images for a network, and labels from its scores.

A *representation* converts panoramas to images for a network: tangent images or, as
baselines, the faces of a cube, the equirectangular image itself or crops of it. It draws the
*views* of one training sample (which images, rotated and mirrored how), gives the views of the
whole sphere for evaluation, and assembles the scores of the latter. Data modules and tasks use
nothing else of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.forward import Interpolation, equirect_to_tangent

RotationAugmentation = Literal["none", "yaw", "so3"]
"""Rotation of training panoramas: none, about the vertical, or uniformly over SO(3)."""

Image = NDArray[Any]

NO_RAYS: NDArray[np.float32] = np.empty((0, 3, 3), np.float32)
"""The rays of views that are not pinhole images of a sphere."""

NOT_ROTATED: NDArray[np.float64] = np.eye(3)[None]
"""Rotations of views that are not rotated."""


class Views(Protocol):
    """Views of one panorama or photo; neither on the sphere nor rotated, unless they say so."""

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render it ``(H, W[, C])`` to images ``(n, h, w[, C])``, dtype kept."""
        ...

    def rays(self) -> NDArray[np.float32]:
        """``(n, 3, 3)`` viewing rays of the images; `NO_RAYS` if they are not pinhole images.

        Each matrix maps ``(x, y, 1)``, with x and y from −1 at the left and upper edge of an image
        to 1 at the opposite one, to a direction (of any length) on the sphere.
        """
        return NO_RAYS

    def rotations(self) -> NDArray[np.float64]:
        """``(K, 3, 3)`` rotations of the whole representation they are of: directions are R·d."""
        return NOT_ROTATED


class Sampler(Protocol):
    """Draws views."""

    def sample(self, rng: np.random.Generator) -> Views:
        """Views of one training sample: a random subset, augmented."""
        ...

    def whole(self) -> Views:
        """Views of the whole panorama or photo, in a fixed order."""
        ...


@runtime_checkable
class Assembler(Protocol):
    """Convert scores to labels: the part of a representation that a task uses."""

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        ...

    def to_labels(
        self, scores: Tensor, shape: Any, rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """Class index of every pixel of the panorama or photo.

        Args:
            scores: ``(n, K, h, w)`` of all images of `Sampler.whole`; of one rotation.
            shape: Of the ground truth.
            rotation: Of the views, one of `Views.rotations`; None where they are not rotated.
        """
        ...


@runtime_checkable
class Representation(Sampler, Assembler, Protocol):
    """Images of a panorama for a network, and their assembly."""

    @property
    def erp_height(self) -> int:
        """Rows of the panorama it reads and is scored on."""
        ...

    def turned(self, rotation: NDArray[np.float64]) -> Self:
        """The same, looking in rotated directions R·d: for panoramas that are not upright."""
        ...


@dataclass(frozen=True)
class PinholeViews:
    """Pinhole images.

    Attributes:
        grid: All of them.
        faces: Those that are rendered; None for all.
        mirrored: Whether each image is mirrored left to right.
    """

    grid: PinholeGrid
    faces: NDArray[np.int64] | None = None
    mirrored: bool = False

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to images ``(n, d, d[, C])``, dtype kept."""
        images = equirect_to_tangent(image, self.grid, self.faces, interpolation)
        return np.ascontiguousarray(images[:, :, ::-1]) if self.mirrored else images

    def rays(self) -> NDArray[np.float32]:
        """Camera axes, scaled to the images' edges; see `Views`."""
        grid = self.grid
        edge = grid.dim / 2 * grid.pitch
        axes = grid.world_from_camera[grid.face_indices(self.faces)]
        return (axes * (-edge if self.mirrored else edge, edge, 1)).astype(np.float32)

    def rotations(self) -> NDArray[np.float64]:
        """That of the grid."""
        return NOT_ROTATED if self.grid.rotation is None else self.grid.rotation[None]


@dataclass(frozen=True)
class ManyViews:
    """The images of several views of the same panorama, one after the other.

    Attributes:
        parts: The views.
    """

    parts: tuple[Views, ...]

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to images ``(n, d, d[, C])``, dtype kept."""
        return np.concatenate([part.render(image, interpolation) for part in self.parts])

    def rays(self) -> NDArray[np.float32]:
        """Those of all parts."""
        return np.concatenate([part.rays() for part in self.parts])

    def rotations(self) -> NDArray[np.float64]:
        """Those of all parts."""
        return np.concatenate([part.rotations() for part in self.parts])
