"""Representations of panoramas: the images that a network is given.

A *representation* selects the *views* of a panorama: tangent images or, as baselines, the faces of
a cube, the equirectangular image itself or crops of it. It draws the views of one training sample
(which images, rotated and mirrored how), and lists the sets of views that evaluation and prediction
average over. Views render themselves from an image, and say where they lie on its canvas (see
`kernels`). `inference.engine` gives them to the network.
"""

from __future__ import annotations

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


class Placement(Protocol):
    """Some of N images on a canvas: a panorama, or a photo."""

    @property
    def chosen(self) -> NDArray[np.int64]:
        """``(n,)`` numbers of the images, 0 … N − 1."""
        ...

    @property
    def all_images(self) -> object:
        """The same object for all parts of one set of images."""
        ...

    @property
    def overlapping(self) -> bool:
        """True if every pixel of the canvas is inside an image, not only on its outer edge."""
        ...

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """``(H, W)`` number of the image whose center is nearest to each pixel of the canvas."""
        ...

    def geometry(
        self, shape: tuple[int, int], rows: slice, owner: NDArray[np.integer]
    ) -> CanvasGeometry:
        """Geometry of some rows of the canvas.

        Args:
            shape: ``(H, W)`` of the canvas.
            rows: Rows of the canvas, without a step.
            owner: Owners of these rows; empty for feathering.
        """
        ...

    def owned_spans(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """``(n, H, 2)`` spans of pixels of the canvas that contain those that an image owns."""
        ...


class Views(Protocol):
    """Views of one panorama or photo."""

    def __len__(self) -> int:
        """Number of views."""
        ...

    def __getitem__(self, part: slice) -> Self:
        """Some of the views."""
        ...

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """Render an array ``(H, W[, C])`` to ``(n, h, w[, C])``, a tensor ``(C, H, W)`` to
        ``(n, C, h, w)``; the dtype is kept.
        """  # noqa: D205
        ...

    def rays(self) -> NDArray[np.float32]:
        """``(n, 3, 3)`` viewing rays of the images; `NO_RAYS` if they are not pinhole images.

        Each matrix maps ``(x, y, 1)``, with x and y from −1 at the left and upper edge of an image
        to 1 at the opposite one, to a direction (of any length) on the sphere.
        """
        ...

    def placed(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Placement]:
        """Scores ``(n, K, h, w)`` of the views as images on the canvas ``(H, W)``."""
        ...


class Sampler(Protocol):
    """Selects views of one panorama or photo."""

    def sample(self, rng: np.random.Generator) -> Views:
        """Views of one training sample: a random subset, augmented."""
        ...

    def view_sets(self) -> list[Any]:
        """Sets of `Views` that each cover the whole; the scores of several sets are averaged."""
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
class PinholeViews:
    """Pinhole images.

    Attributes:
        grid: Geometry of all images.
        faces: Images that are rendered; None for all.
        mirrored: True if each image is mirrored left to right.
    """

    grid: PinholeGrid
    faces: NDArray[np.int64] | None = None
    mirrored: bool = False

    def __len__(self) -> int:
        return self.grid.num_images if self.faces is None else len(self.faces)

    def __getitem__(self, part: slice) -> Self:
        return replace(self, faces=self.chosen[part])

    @property
    def chosen(self) -> NDArray[np.int64]:
        """See `Placement`."""
        return self.grid.face_indices(self.faces)

    @property
    def all_images(self) -> object:
        """See `Placement`."""
        return self.grid

    @property
    def overlapping(self) -> bool:
        """See `Placement`."""
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

    def placed(self, scores: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Placement]:
        """See `Views`."""
        del shape
        return scores, self

    def owners(self, shape: tuple[int, int]) -> NDArray[np.integer]:
        """See `Placement`."""
        return owners(self.grid, shape)

    def geometry(
        self, shape: tuple[int, int], rows: slice, owner: NDArray[np.integer]
    ) -> CanvasGeometry:
        """See `Placement`."""
        return canvas_geometry(self.grid, self.chosen, shape, rows, owner)

    def owned_spans(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """See `Placement`."""
        grid = self.grid
        beyond = grid.widened(-((grid.dim - grid.owned_dim) // 2))
        return find_spans(beyond, self.chosen, shape, slice(0, shape[0]))
