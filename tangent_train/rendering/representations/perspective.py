"""Photos as network input: crops of one common camera (paper, supplement, section 2.1).

Photos of any camera become images of the same angular resolution as a panorama's, so that a network
trained on them sees objects at their size in tangent images. The common camera has
the side W' = H' and the field of view Ω': ``f' = W' / (2 tan(Ω'/2))``; a crop is
``x' = K'(K+Δ)⁻¹x`` with a shift Δ that keeps it inside the photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import shift_range
from tangent_train.registry import registered
from tangent_train.rendering.forward import Interpolation
from tangent_train.rendering.representations.views import Views

_PAPER_FOV_DEG = 45.0

_NEGLIGIBLE = 1e-6
"""Share of a crop's side that may stay uncovered."""


@dataclass(frozen=True)
class PhotoCrops(Views):
    """Crops of one photo.

    Attributes:
        boxes: ``(n, 4)`` left, top, right and bottom in the photo, in pixels from its corner.
        size: Rows and columns of the crops.
        mirrored: Whether they are mirrored left to right.
    """

    boxes: NDArray[np.float64]
    size: tuple[int, int]
    mirrored: bool = False

    def render(self, image: NDArray[Any], interpolation: Interpolation) -> NDArray[Any]:
        """Render a photo ``(H, W[, C])`` to crops ``(n, h, w[, C])``, dtype kept.

        Args:
            image: The photo; for `bilinear` uint8.
            interpolation: `bilinear` antialiases when it downsamples (a triangle filter two crop
                pixels wide). `nearest` takes the pixel at the centre.
        """
        draw = _nearest if interpolation == "nearest" else _smooth
        crops = np.stack([draw(image, box, self.size) for box in self.boxes])
        return np.ascontiguousarray(crops[:, :, ::-1]) if self.mirrored else crops

    def owned(self) -> NDArray[np.bool_]:
        """Pixels of each crop that lie nearer to its centre than to any other's, ``(n, h, w)``.

        So every point of the photo counts once, however much the crops overlap.
        """
        cells = self.cells()
        across, down = (
            (cells[:, None, axis] <= places) & (places < cells[:, None, axis + 2])
            for axis in (0, 1)
            for places in [self._places(axis)]
        )
        return down[:, :, None] & across[:, None, :]

    def owners(self, shape: tuple[int, int]) -> NDArray[np.int32]:
        """``(H, W)`` the crop whose centre is nearest to each pixel of the photo."""
        height, width = shape
        edges = np.ceil(self.cells() - 0.5).clip(0, (width, height, width, height)).astype(int)
        owner = np.zeros(shape, np.int32)
        for number, (left, top, right, bottom) in enumerate(edges):
            owner[top:bottom, left:right] = number
        return owner

    def cells(self) -> NDArray[np.float64]:
        """The part of the photo that lies nearer to a crop's centre than to any other's.

        Returns:
            ``(n, 4)`` left, top, right and bottom, as `boxes`; infinite beyond the outermost.
        """
        cells = np.empty_like(self.boxes)
        for axis in (0, 1):
            middle = (self.boxes[:, axis] + self.boxes[:, axis + 2]) / 2
            centers, own = np.unique(np.round(middle, 6), return_inverse=True)
            edges = np.array([-np.inf, *(centers[1:] + centers[:-1]) / 2, np.inf])
            cells[:, axis], cells[:, axis + 2] = edges[own], edges[own + 1]
        return cells

    def _places(self, axis: int) -> NDArray[np.float64]:
        """``(n, pixels)`` where the centres of a crop's columns (0) or rows (1) are."""
        near, far, count = self.boxes[:, axis], self.boxes[:, axis + 2], self.size[1 - axis]
        return np.linspace(near, far, 2 * count + 1, axis=1)[:, 1::2]


def _smooth(image: NDArray[Any], box: NDArray[np.float64], size: tuple[int, int]) -> NDArray[Any]:
    resized = Image.fromarray(image).resize(
        size[::-1], Image.Resampling.BILINEAR, box=tuple(box.tolist())
    )
    return np.asarray(resized)


def _nearest(image: NDArray[Any], box: NDArray[np.float64], size: tuple[int, int]) -> NDArray[Any]:
    columns, rows = (
        np.linspace(near, far, 2 * count + 1)[1::2].astype(np.intp)
        for near, far, count in zip(box[:2], box[2:], size[::-1], strict=True)
    )
    return image[rows][:, columns]


@dataclass(frozen=True)
class PhotoSampler:
    """Draws crops of photos of one camera.

    Attributes:
        camera_matrix: ``(3, 3)`` K, integer pixel centres.
        size: ``(height, width)`` of the photo.
        representation: The common camera, and the selection of crops.
    """

    camera_matrix: NDArray[np.float64]
    size: tuple[int, int]
    representation: PerspectiveRepresentation

    def sample(self, rng: np.random.Generator) -> PhotoCrops:
        """Crops anywhere in the photo."""
        wanted = self.representation
        least, greatest = self._shifts()
        shifts = rng.uniform(least, greatest, (wanted.crops_per_photo, 2))
        return self._crops(shifts, mirrored=wanted.mirror and bool(rng.random() < 0.5))

    def whole(self) -> PhotoCrops:
        """The fewest crops that cover the photo, evenly spread."""
        return self.cover()

    def cover(self, overlap: float = 0.0) -> PhotoCrops:
        """The fewest crops that cover the photo, evenly spread.

        Args:
            overlap: The least share of its side by which a crop overlaps the next, 0 to below 1.
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
        wanted = self.representation
        return shift_range(self.camera_matrix, self.size, wanted.fov_deg, wanted.image_size)

    def _extent(self) -> NDArray[np.float64]:
        """Width and height of a crop in pixels of the photo."""
        rows, columns = self.representation.image_size
        width = 2 * math.tan(math.radians(self.representation.fov_deg) / 2)
        return np.diag(self.camera_matrix)[:2] * width * (1, rows / columns)

    def _crops(self, shifts: NDArray[np.float64], *, mirrored: bool = False) -> PhotoCrops:
        """Crops whose corners `normalize_camera` moves there, see its homography."""
        centers, half = self.camera_matrix[:2, 2] + 0.5 + shifts, self._extent() / 2
        boxes = np.concatenate([centers - half, centers + half], axis=1)
        inside = boxes.clip(0, np.tile(self.size[::-1], 2))  # rounding may lead outside
        return PhotoCrops(inside, self.representation.image_size, mirrored)


@registered
class PerspectiveRepresentation:
    """Crops of photos, all of one camera; evaluation covers the photo, each place counted once.

    Args:
        level: Level s of the panoramas whose angular resolution the crops have.
        fov_deg: Horizontal field of view Ω' of a crop in degrees.
        dim: Side W' = H' of a crop in pixels, or ``[H', W']``; default that of the paper's
            resolution: 2^(s−1) for 45°, 128 at level 8, more for a wider view. Pixels are square.
        crops_per_photo: Crops drawn at random for a training sample.
        mirror: Mirror half of the training samples left to right.

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
        """The sampler of the crops of a photo.

        Args:
            camera_matrix: ``(3, 3)`` K of the photo, integer pixel centres, without skew.
            size: ``(height, width)`` of the photo.
        """
        return PhotoSampler(camera_matrix, size, self)

    def to_labels(
        self, scores: Tensor, shape: tuple[int, ...], rotation: NDArray[np.float64] | None = None
    ) -> Tensor:
        """The best class of every pixel of every crop.

        Args:
            scores: Of all crops.
            shape: Ignored: that of the crops.
            rotation: Ignored: photos are not rotated.
        """
        del shape, rotation
        return scores.argmax(dim=1)
