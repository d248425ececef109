"""Representations of panoramas: the images that a network is given.

A *representation* selects the *views* of a panorama: tangent images or, as baselines, the faces of
a cube, the equirectangular image itself or crops of it. It draws the views of one training sample
(which images, rotated and mirrored how), and lists the sets of views that evaluation and prediction
average over. Views render themselves from an image, and say where they lie on its canvas (see
`kernels`). `inference.engine` gives them to the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.checks import Blend
from tangent_train.rendering.forward import Interpolation, Pixels, equirect_to_tangent
from tangent_train.rendering.kernels import CanvasGeometry
from tangent_train.rendering.tables import canvas_geometry, find_spans, owners

RotationAugmentation = Literal["none", "yaw", "so3"]
"""Rotation of training panoramas: none, about the vertical, or uniformly over SO(3)."""

NO_RAYS: NDArray[np.float32] = np.empty((0, 3, 3), np.float32)
"""The rays of views that are not pinhole images of a sphere."""


class Views:
    """Views of one panorama or photo: some of N images that each show a part of it.

    Attributes:
        overlapping: True if every pixel is inside an image, not only on its outer edge.
        chosen: ``(n,)`` numbers of these views, 0 … N − 1.
        all_images: The same object for all parts of one set of images.
    """

    overlapping: bool
    chosen: NDArray[np.int64]
    all_images: object

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, part: slice) -> Self:
        """Some of the views."""
        raise NotImplementedError

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """Render the views, dtype kept.

        Args:
            image: An array ``(H, W[, C])``, or a tensor ``(C, H, W)``.
            interpolation: ``bilinear`` or ``nearest``.

        Returns:
            An array ``(n, h, w[, C])``, or a tensor ``(n, C, h, w)``.
        """
        raise NotImplementedError

    def rays(self) -> NDArray[np.float32]:
        """``(n, 3, 3)`` viewing rays of the images; `NO_RAYS` if they are not pinhole images.

        Each matrix maps ``(x, y, 1)``, with x and y from −1 at the left and upper edge of an image
        to 1 at the opposite one, to a direction (of any length) on the sphere.
        """
        return NO_RAYS

    def placed(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Scores ``(n, K, h, w)`` as images on the canvas ``(H, W)``, and these images."""
        del shape
        return scores, self

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """``(H, W)`` number of the image whose center is nearest to each pixel of the canvas."""
        raise NotImplementedError

    def geometry(
        self, shape: tuple[int, int], rows: slice, owner: NDArray[np.integer]
    ) -> CanvasGeometry:
        """Geometry of some rows of the canvas.

        Args:
            shape: ``(H, W)`` of the canvas.
            rows: Rows of the canvas, without a step.
            owner: Owners of these rows; empty for feathering.
        """
        raise NotImplementedError

    def owned_spans(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """``(n, H, 2)`` spans of pixels of the canvas that contain those that an image owns."""
        raise NotImplementedError


class Sampler(Protocol):
    """Selects views of one panorama or photo."""

    def sample(self, rng: np.random.Generator) -> Views:
        """Views of one training sample: a random subset, augmented."""
        ...

    def view_sets(self) -> Sequence[Views]:
        """Sets of views that each cover the whole; the scores of several sets are averaged."""
        ...


@runtime_checkable
class Representation(Sampler, Protocol):
    """The images of a panorama that a network is given."""

    blend: Blend

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        ...

    @property
    def erp_height(self) -> int:
        """Rows of the panorama it reads and is scored on."""
        ...

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """The same representation in rotated directions R·d, for tilted panoramas."""
        ...


@dataclass(frozen=True, eq=False)
class PinholeViews(Views):
    """Pinhole images.

    Attributes:
        grid: Geometry of all images.
        faces: Images that are rendered; None for all.
        mirrored: True if each image is mirrored left to right.
    """

    grid: PinholeGrid
    faces: NDArray[np.int64] | None = None
    mirrored: bool = False

    def __getitem__(self, part: slice) -> Self:
        return replace(self, faces=self.chosen[part])

    @property
    def chosen(self) -> NDArray[np.int64]:  # type: ignore[override]
        """See `Views`."""
        return self.grid.face_indices(self.faces)

    @property
    def all_images(self) -> object:  # type: ignore[override]
        """See `Views`."""
        return self.grid

    @property
    def overlapping(self) -> bool:  # type: ignore[override]
        """See `Views`."""
        return self.grid.overlapping

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """See `Views`."""
        images: Any = equirect_to_tangent(image, self.grid, self.faces, interpolation)
        if not self.mirrored:
            return images
        if isinstance(image, Tensor):
            flipped: Any = images.flip(-1)
            return flipped
        mirrored: Any = np.ascontiguousarray(images[:, :, ::-1])
        return mirrored

    def rays(self) -> NDArray[np.float32]:
        """Camera axes, scaled to the images' edges; see `Views`."""
        grid = self.grid
        edge = grid.dim / 2 * grid.pitch
        axes = grid.world_from_camera[self.chosen]
        return (axes * (-edge if self.mirrored else edge, edge, 1)).astype(np.float32)

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """See `Views`."""
        return owners(self.grid, shape)

    def geometry(
        self, shape: tuple[int, int], rows: slice, owner: NDArray[np.integer]
    ) -> CanvasGeometry:
        """See `Views`."""
        return canvas_geometry(self.grid, self.chosen, shape, rows, owner)

    def owned_spans(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """See `Views`."""
        grid = self.grid
        beyond = grid.widened(-((grid.dim - grid.owned_dim) // 2))
        return find_spans(beyond, self.chosen, shape, slice(0, shape[0]))
