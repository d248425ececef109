"""Representations of panoramas: the images that a network gets as input.

A *representation* selects the *views* of a panorama: tangent images or, as baselines, the faces of
a cube, the equirectangular image itself, crops of it or a signal on an icosphere. It selects the
views of one training sample with random subsets, rotations and mirroring, and lists the sets of
views that evaluation and prediction average over. Views render themselves from an image, and
provide their position on its canvas (see `kernels`). `inference.engine` passes them to the network.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid, ray_lengths
from tangent_train.rendering.forward import Blend, equirect_to_tangent
from tangent_train.rendering.kernels import CanvasGeometry
from tangent_train.rendering.resampling import Interpolation, Pixels, is_tensor, reduce_to_pitch
from tangent_train.rendering.tables import canvas_geometry, owners

if TYPE_CHECKING:
    from torch import Tensor

RotationAugmentation = Literal["none", "yaw", "so3"]
"""Rotation of training panoramas: none, about the vertical, or uniformly over SO(3)."""

STRIDE = 32
"""The stride of most networks: sides of views are multiples of it where they can be chosen."""

NO_RAYS: NDArray[np.float32] = np.empty((0, 3, 3), np.float32)
"""The rays of views that are not pinhole images of a sphere."""


class Views:
    """Some of the N views of a panorama or photo, each an image of a part of it.

    Attributes:
        is_overlapping: True if every pixel is inside an image, not only on its outer edge.
        chosen: ``(n,)`` numbers of these views, 0 … N − 1.
        num_images: Number N of views in the set.
        key: A value that views of the same set of N views share.
        is_rotated: True if the set is one of many under different rotations.
    """

    is_overlapping: bool
    chosen: NDArray[np.int64] = np.zeros(1, np.int64)
    num_images: int = 1
    key: Hashable
    is_rotated: bool = False

    @property
    def whole(self) -> Self:
        """All N views of the set."""
        return self

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, part: slice) -> Self:
        """Return some of the views; a single one is returned itself."""
        return self

    def reduced(self, image: Pixels) -> Pixels:
        """Return an image at the resolution of the views, for many calls of `render`."""
        return image

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """Render the views, with the dtype of the image.

        Args:
            image: An array ``(H, W[, C])``, or a tensor ``(C, H, W)``.
            interpolation: ``bilinear`` or ``nearest``.

        Returns:
            An array ``(n, h, w[, C])``, or a tensor ``(n, C, h, w)``.
        """
        raise NotImplementedError

    def rays(self) -> NDArray[np.float32]:
        """Return ``(n, 3, 3)`` viewing rays; `NO_RAYS` if the views are not pinhole images.

        Each matrix maps ``(x, y, 1)`` to a direction of any length on the sphere. x runs from −1 at
        the left edge of an image to 1 at the right edge, y from −1 at the top to 1 at the bottom.
        """
        return NO_RAYS

    def ray_lengths(self) -> NDArray[np.float32]:
        """Return distance divided by z-depth at every pixel, ``(1 or n, h, w)``.

        It is √(1 + x² + y²) at the position (x, y) on the image plane at distance 1. In views that
        are not pinhole images, z-depth is the distance: ``(1, 1, 1)``, a 1.
        """
        return np.ones((1, 1, 1), np.float32)

    def on_canvas(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Views]:
        """Return scores ``(n, K, h, w)`` as images on the canvas ``(H, W)``, and their geometry."""
        del shape
        return scores, self

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """Return the number of the image with the nearest center for each pixel ``(H, W)``."""
        raise NotImplementedError

    def geometry(self, shape: tuple[int, int], owner: NDArray[np.integer] | None) -> CanvasGeometry:
        """Return the geometry of the views and the canvas.

        Args:
            shape: ``(H, W)`` of the canvas.
            owner: ``(H, W)`` owners; None for feathering.
        """
        raise NotImplementedError


class Sampler(Protocol):
    """Selects views of one panorama or photo.

    Views that see no valid pixel ``(H, W)`` of a panorama are left out; None if all are valid.
    """

    def sample(self, rng: np.random.Generator, valid: NDArray[np.bool_] | None = None) -> Views:
        """Return the views of one training sample: a random subset, augmented."""
        ...

    def view_sets(self, valid: NDArray[np.bool_] | None = None) -> Sequence[Views]:
        """Return sets of views that each cover the valid pixels; their scores are averaged."""
        ...


@runtime_checkable
class Representation(Sampler, Protocol):
    """The views of a panorama that a network gets as input."""

    blend: Blend

    @property
    def image_size(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        ...

    @property
    def erp_height(self) -> int:
        """Rows of the panorama from which views are rendered, and on which scores are computed."""
        ...

    def with_rotation(self, rotation: NDArray[np.float64]) -> Self:
        """Return the same representation in rotated directions R·d, for tilted panoramas."""
        ...


@dataclass(frozen=True, eq=False)
class PinholeViews(Views):
    """Pinhole images.

    Attributes:
        grid: Geometry of all images.
        faces: Indices of the images that are rendered; None for all.
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
    def key(self) -> Hashable:  # type: ignore[override]
        """See `Views`."""
        return self.grid

    @property
    def is_rotated(self) -> bool:  # type: ignore[override]
        """See `Views`."""
        return self.grid.rotation is not None

    @property
    def whole(self) -> Self:
        """See `Views`."""
        return replace(self, faces=None)

    @property
    def num_images(self) -> int:  # type: ignore[override]
        """See `Views`."""
        return self.grid.num_images

    @property
    def is_overlapping(self) -> bool:  # type: ignore[override]
        """See `Views`."""
        return self.grid.is_overlapping

    def reduced(self, image: Pixels) -> Pixels:
        """See `Views`."""
        return reduce_to_pitch(image, min(self.grid.pitches))

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """See `Views`."""
        images: Any = equirect_to_tangent(image, self.grid, self.faces, interpolation)
        if not self.mirrored:
            return images
        if is_tensor(image):
            flipped: Any = images.flip(-1)
            return flipped
        mirrored: Any = np.ascontiguousarray(images[:, :, ::-1])
        return mirrored

    def rays(self) -> NDArray[np.float32]:
        """Return camera axes, scaled to the images' edges; see `Views`."""
        grid = self.grid
        x, y = grid.half_size
        axes = grid.world_from_camera[self.chosen]
        return (axes * (-x if self.mirrored else x, y, 1)).astype(np.float32)

    def ray_lengths(self) -> NDArray[np.float32]:
        """See `Views`; equal for all images, mirrored or not."""
        return ray_lengths(self.grid.camera_matrix, self.grid.size)[None].astype(np.float32)

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """See `Views`."""
        return owners(self.grid, shape)

    def geometry(self, shape: tuple[int, int], owner: NDArray[np.integer] | None) -> CanvasGeometry:
        """See `Views`."""
        return canvas_geometry(self.grid, self.chosen, shape, owner)
