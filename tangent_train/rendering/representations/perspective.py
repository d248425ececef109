"""Photos as network input: crops of one common camera (paper, supplement, section 2.1).

Photos of different cameras become images of the same angular resolution as a panorama's, so that a
network trained on them gets objects of the same size in tangent images. The common camera has the
side W' = H' and the field of view Ω': ``f' = W' / (2 tan(Ω'/2))``. A crop is ``x' = K'(K+Δ)⁻¹x``
with a shift Δ that keeps it inside the photo.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import lengths_of_rays, shift_range
from tangent_train.rendering.kernels import NO_OWNERS, CanvasGeometry
from tangent_train.rendering.representations.views import Views
from tangent_train.rendering.resampling import Interpolation, Pixels, crop, is_tensor
from tangent_train.rendering.tables import plane_rays

_PAPER_FOV_DEG = 45.0

_NEGLIGIBLE = 1e-6
"""Share of a crop's side that may remain uncovered, for rounding."""


@dataclass(frozen=True, eq=False)
class PhotoCrops(Views):
    """Crops of one photo.

    Attributes:
        boxes: ``(N, 4)`` left, top, right and bottom of all crops, in pixels from the photo's
            corner.
        size: Rows and columns of a crop.
        mirrored: True if the crops are mirrored left to right.
        numbers: ``(n,)`` numbers of the crops that are rendered; None for all.
        canvas_boxes: ``(N, 4)`` boxes on the canvas; None if the photo itself is the canvas.
        is_overlapping: See `Views`.
        camera_matrix: ``(3, 3)`` K of the photo, integer pixel centers; None if it is not a pinhole
            image.
    """

    boxes: NDArray[np.float64]
    size: tuple[int, int]
    mirrored: bool = False
    numbers: NDArray[np.int64] | None = None
    canvas_boxes: NDArray[np.float64] | None = None
    is_overlapping: bool = True
    camera_matrix: NDArray[np.float64] | None = None

    def __getitem__(self, part: slice) -> Self:
        return replace(self, numbers=self.chosen[part])

    @property
    def chosen(self) -> NDArray[np.int64]:  # type: ignore[override]
        """See `Views`."""
        return np.arange(len(self.boxes)) if self.numbers is None else self.numbers

    @property
    def num_images(self) -> int:  # type: ignore[override]
        """See `Views`."""
        return len(self.boxes)

    @property
    def key(self) -> Hashable:  # type: ignore[override]
        """See `Views`."""
        return self._on_canvas.tobytes(), self.size

    @property
    def whole(self) -> Self:
        """See `Views`."""
        return replace(self, numbers=None)

    def render(self, image: Pixels, interpolation: Interpolation) -> Pixels:
        """See `Views`; arrays must be uint8 for ``bilinear``."""
        parts: Any = [crop(image, b, self.size, interpolation) for b in self.boxes[self.chosen]]
        if is_tensor(image):
            import torch

            crops = torch.stack(parts)
            return crops.flip(-1) if self.mirrored else crops
        crops = np.stack(parts)
        return np.ascontiguousarray(crops[:, :, ::-1]) if self.mirrored else crops

    def ray_lengths(self) -> NDArray[np.float32]:
        """See `Views`; the optical axis is that of the photo, wherever a crop is."""
        if self.camera_matrix is None:
            return super().ray_lengths()
        x, y = (
            (self._pixel_centers(axis)[self.chosen] - 0.5 - self.camera_matrix[axis, 2])
            / self.camera_matrix[axis, axis]
            for axis in (0, 1)
        )
        return lengths_of_rays(x[:, ::-1] if self.mirrored else x, y).astype(np.float32)

    def owned(self) -> NDArray[np.bool_]:
        """Return a mask of the pixels nearer to the crop's center than to any other, ``(n, h, w)``.

        With it, every point of the photo counts once, even where crops overlap.
        """
        cells = cells_of(self.boxes)
        across, down = (
            (cells[:, None, axis] <= centers) & (centers < cells[:, None, axis + 2])
            for axis in (0, 1)
            for centers in [self._pixel_centers(axis)]
        )
        return down[:, :, None] & across[:, None, :]

    def owners(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """See `Views`."""
        height, width = shape
        edges = np.ceil(cells_of(self._on_canvas) - 0.5).clip(0, (width, height, width, height))
        owner = np.zeros(shape, np.int32)
        for number, (left, top, right, bottom) in enumerate(edges.astype(np.intp)):
            owner[top:bottom, left:right] = number
        return owner

    def geometry(self, shape: tuple[int, int], owner: NDArray[np.integer] | None) -> CanvasGeometry:
        """See `Views`."""
        boxes = self._on_canvas[self.chosen]
        across, down = (self.size[1 - i] / (boxes[:, 2 + i] - boxes[:, i]) for i in (0, 1))
        # For rays (j, 1, i): the center of pixel j is j + ½ from the photo's corner.
        matrices = np.zeros((len(boxes), 3, 3))
        matrices[:, 0, 0], matrices[:, 0, 1] = across, (0.5 - boxes[:, 0]) * across - 0.5
        matrices[:, 1, 2], matrices[:, 1, 1] = down, (0.5 - boxes[:, 1]) * down - 0.5
        matrices[:, 2, 1] = 1
        columns, lines = plane_rays(shape)
        seen = np.concatenate([np.floor(boxes[:, :2]), np.ceil(boxes[:, 2:])], axis=1)
        spans = _spans(seen, shape)
        owner = NO_OWNERS if owner is None else owner
        return CanvasGeometry(self.chosen, matrices, spans, columns, lines, owner)

    @property
    def _on_canvas(self) -> NDArray[np.float64]:
        return self.boxes if self.canvas_boxes is None else self.canvas_boxes

    def _pixel_centers(self, axis: int) -> NDArray[np.float64]:
        """Return ``(n, pixels)`` positions in the photo of a crop's columns (0) or rows (1)."""
        near, far, count = self.boxes[:, axis], self.boxes[:, axis + 2], self.size[1 - axis]
        return np.linspace(near, far, 2 * count + 1, axis=1)[:, 1::2]


def cells_of(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the part of the photo that is nearer to each crop's center than to any other.

    Args:
        boxes: ``(N, 4)`` left, top, right and bottom of all crops.

    Returns:
        ``(N, 4)`` cells; the outer edges of the outermost cells are infinite.
    """
    cells = np.empty_like(boxes)
    for axis in (0, 1):
        middle = (boxes[:, axis] + boxes[:, axis + 2]) / 2
        centers, number = np.unique(np.round(middle, 6), return_inverse=True)
        edges = np.array([-np.inf, *(centers[1:] + centers[:-1]) / 2, np.inf])
        cells[:, axis], cells[:, axis + 2] = edges[number], edges[number + 1]
    return cells


def _spans(edges: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.int32]:
    """Return ``(n, H, 2)`` spans of rectangles, see `CanvasGeometry`."""
    height, width = shape
    spans = np.zeros((len(edges), height, 2), np.int32)
    clipped = edges.clip(0, (width, height, width, height)).astype(int)
    for span, (left, top, right, bottom) in zip(spans, clipped, strict=True):
        span[top:bottom] = left, right - left
    return spans


@dataclass(frozen=True)
class PhotoSampler:
    """Selects crops of photos of one camera.

    Attributes:
        camera_matrix: ``(3, 3)`` K, integer pixel centers.
        size: ``(height, width)`` of the photo.
        representation: The common camera, and the selection of crops.
    """

    camera_matrix: NDArray[np.float64]
    size: tuple[int, int]
    representation: PerspectiveRepresentation

    def sample(self, rng: np.random.Generator, valid: None = None) -> PhotoCrops:
        """Return crops at random positions in the photo; all its pixels are valid."""
        del valid
        common = self.representation
        least, greatest = self._shifts()
        shifts = rng.uniform(least, greatest, (common.crops_per_photo, 2))
        return self._crops(shifts, mirrored=common.mirror and bool(rng.random() < 0.5))

    def view_sets(self, valid: None = None) -> list[PhotoCrops]:
        """Return the fewest crops that cover the photo, evenly spaced."""
        del valid
        return [self.cover()]

    def cover(self, overlap: float = 0.0) -> PhotoCrops:
        """Return the fewest crops that cover the photo, evenly spaced.

        Args:
            overlap: Minimum overlap of neighboring crops as a share of their side, from 0 to less
                than 1.
        """
        least, greatest = self._shifts()
        extent = self._extent() * (1 - overlap)
        count = 1 + np.ceil((greatest - least) / extent - _NEGLIGIBLE).astype(int)
        across, down = (
            np.linspace(a, b, n) if n > 1 else np.clip([0.0], a, b)
            for a, b, n in zip(least, greatest, count, strict=True)
        )
        return self._crops(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))

    def _shifts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        common = self.representation
        return shift_range(self.camera_matrix, self.size, common.fov_deg, common.image_size)

    def _extent(self) -> NDArray[np.float64]:
        """Return width and height of a crop in pixels of the photo."""
        rows, columns = self.representation.image_size
        width = 2 * math.tan(math.radians(self.representation.fov_deg) / 2)
        return np.diag(self.camera_matrix)[:2] * width * (1, rows / columns)

    def _crops(self, shifts: NDArray[np.float64], *, mirrored: bool = False) -> PhotoCrops:
        """Return crops with their centers shifted from the principal point."""
        centers, half = self.camera_matrix[:2, 2] + 0.5 + shifts, self._extent() / 2
        boxes = np.concatenate([centers - half, centers + half], axis=1)
        inside = boxes.clip(0, np.tile(self.size[::-1], 2))  # rounding may exceed the photo
        size, matrix = self.representation.image_size, self.camera_matrix
        return PhotoCrops(inside, size, mirrored, camera_matrix=matrix)


class PerspectiveRepresentation:
    """Crops of photos, normalized to one camera. Evaluation covers the photo and counts it once.

    Args:
        level: Level s of panoramas with the same angular resolution.
        fov_deg: Horizontal field of view Ω' of a crop in degrees.
        dim: Side W' = H' of a crop in pixels, or ``[H', W']``. The default is the paper's
            resolution: 2^(s−1) for 45°, such as 128 at level 8, and more for a wider view. Pixels
            are square.
        crops_per_photo: Number of random crops in a training sample.
        mirror: True to mirror half of the training samples left to right.

    Attributes:
        image_size: Rows and columns of a crop.

    Raises:
        SettingError: A setting is invalid.
    """

    def __init__(
        self,
        level: int,
        fov_deg: float = 45.0,
        dim: int | Sequence[int] | None = None,
        crops_per_photo: int = 1,
        mirror: bool = False,
    ) -> None:
        wider = math.tan(math.radians(fov_deg) / 2) / math.tan(math.radians(_PAPER_FOV_DEG) / 2)
        dim = max(2, round(2 ** (level - 1) * wider)) if dim is None else dim
        sides = (dim, dim) if isinstance(dim, int) else tuple(dim)
        if len(sides) != 2 or min(sides) < 2:
            raise SettingError(
                "representation.dim", found=dim, expected="2 or more, or [height, width]"
            )
        self.image_size = sides[0], sides[1]
        self.fov_deg = fov_deg
        self.crops_per_photo = crops_per_photo
        self.mirror = mirror

    def of_camera(self, camera_matrix: NDArray[np.float64], size: tuple[int, int]) -> PhotoSampler:
        """Return a sampler of crops for photos of a camera.

        Args:
            camera_matrix: ``(3, 3)`` K of the photo, integer pixel centers, without skew.
            size: ``(height, width)`` of the photo.
        """
        return PhotoSampler(camera_matrix, size, self)
