"""Class scores of one panorama or photo, put together image by image.

`tangent_to_labels` wants the scores of all images at once: 5 GB for 13 classes at level 11. Here
they come one image after the other, of any number of grids, and are forgotten. Without averaging
only the labels are kept.
"""

from __future__ import annotations

import math
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.files import reserve
from tangent_train.rendering import kernels, mosaic_kernels
from tangent_train.rendering.checks import check_blend
from tangent_train.rendering.tables import FEATHER_POWER
from tangent_train.rendering.threads import over_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering.backward import Blend
    from tangent_train.rendering.representations.perspective import PhotoCrops

__all__ = ["ScoreMosaic", "window"]

_IN_MEMORY_BYTES = 2**31
"""Sums of more bytes are kept in a temporary file."""


class ScoreMosaic:
    """Scores of K classes at every pixel of a panorama or photo.

    Args:
        shape: ``(H, W)``.
        num_classes: K.
        blend: ``nearest``: a pixel takes the scores of the image that owns it, as in
            `tangent_to_labels`. ``feather``: the weighted average of all images that see it.
        averaged: Whether to keep sums of probabilities: always with ``feather``; with ``nearest``
            for more than one grid, or when the probabilities are wanted. They take 4·K bytes a
            pixel, beyond 2 GiB in a temporary file (of the folder TMPDIR).

    Raises:
        SettingError: An unknown blend, or one the images cannot have.
    """

    def __init__(
        self, shape: tuple[int, int], num_classes: int, blend: Blend, *, averaged: bool = False
    ) -> None:
        self.shape = shape
        self.blend = blend
        self._power = FEATHER_POWER if blend == "feather" else 0
        self._labels = np.zeros(shape, np.uint8 if num_classes < 256 else np.uint16)
        averaged = averaged or blend == "feather"
        self._total = _zeros((*shape, num_classes) if averaged else (0, 0, num_classes))
        self._rays: tuple[NDArray[np.float64], ...] | None = None

    def add(self, scores: Tensor, grid: PinholeGrid, faces: NDArray[np.int64]) -> None:
        """Add some images of a grid; every face of it is to come once.

        Args:
            scores: ``(n, K, d, d)`` scores, not probabilities.
            grid: What they belong to.
            faces: ``(n,)`` which images they are.

        Raises:
            SettingError: The images of the grid do not overlap, as `feather` needs.
        """
        check_blend(self.blend, grid)
        if self._rays is None:
            self._rays = kernels.directions_of_rows(*self.shape)
        for face, image in zip(faces, self._prepared(scores), strict=True):
            others = np.setdiff1d(grid.neighbors[face], face)
            rows, columns = window(grid, face, self.shape)
            self._over(
                rows,
                mosaic_kernels.add_pinhole_image,
                image,
                np.ascontiguousarray(grid.world_from_camera[face]),
                1 / grid.pitch,
                self._power,
                np.ascontiguousarray(grid.centers_xyz[others]),
                int((others < face).sum()),
                not self._power,
                *self._rays,
                *columns,
                self._total,
                self._labels,
            )

    def add_crops(self, scores: Tensor, crops: PhotoCrops, which: NDArray[np.int64]) -> None:
        """Add some crops of a photo; every one of them is to come once.

        Args:
            scores: ``(n, K, h, w)`` scores, not probabilities.
            crops: Where all crops are.
            which: ``(n,)`` which of them these are.
        """
        cells = crops.cells()
        for number, image in zip(which, self._prepared(scores), strict=True):
            box, cell = crops.boxes[number], cells[number]
            rows = max(0, math.floor(box[1])), min(self.shape[0], math.ceil(box[3]))
            self._over(
                rows,
                mosaic_kernels.add_crop,
                image,
                box,
                cell,
                self._power,
                not self._power,
                self._total,
                self._labels,
            )

    def labels(self) -> NDArray[np.unsignedinteger]:
        """``(H, W)`` place of the best class of every pixel; of equal ones the first."""
        if len(self._total):
            over_rows(mosaic_kernels.best_classes, self.shape, self._total, self._labels)
        return self._labels

    def probabilities(self, rows: slice | NDArray[np.intp]) -> NDArray[np.float32]:
        """``(h, W, K)`` probabilities of some rows, which add up to 1; only where averaged."""
        total = self._total[rows]
        return total / np.maximum(total.sum(axis=-1, keepdims=True), np.finfo(np.float32).tiny)

    def _prepared(self, scores: Tensor) -> NDArray[np.float32]:
        """``(n, h, w, K)`` on the CPU; feathered are probabilities, as in evaluation."""
        scores = scores.detach().float()
        if self._power:
            scores = scores.softmax(dim=1)
        return scores.movedim(1, -1).contiguous().cpu().numpy()

    def _over(self, rows: tuple[int, int], kernel: Any, *arguments: Any) -> None:
        first, last = rows

        def of_part(start: int, stop: int) -> None:
            kernel(first + start, first + stop, *arguments)

        over_rows(of_part, (last - first, self.shape[1]))


def _zeros(shape: tuple[int, ...]) -> NDArray[np.float32]:
    nbytes = math.prod(shape) * 4
    if nbytes <= _IN_MEMORY_BYTES:
        return np.zeros(shape, np.float32)
    # The file has no name: it is gone with the array, whatever happens.
    with tempfile.TemporaryFile() as file:
        try:  # now: of a full disk the system says nothing later, it ends the process
            reserve(file, nbytes)
        except OSError as error:
            raise SettingError(
                f"temporary folder {tempfile.gettempdir()}",
                found=error,
                expected=f"room for {nbytes / 1e9:.1f} GB of scores",
                remedy="Set TMPDIR to a folder on a larger disk, or choose blend=nearest.",
            ) from error
        return np.memmap(file, np.float32, "r+", shape=shape)


def window(
    grid: PinholeGrid, face: int, shape: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Where an image may see something of an ERP of this shape: all within its corners' angle.

    Args:
        grid: The images.
        face: Which of them.
        shape: ``(H, W)``.

    Returns:
        First row and the one after the last; first column and number of columns, across ±180°.
    """
    height, width = shape
    x, y, z = grid.centers_xyz[face]
    reach = math.atan(math.sqrt(2) * grid.dim / 2 * grid.pitch)
    latitude = math.asin(max(-1.0, min(1.0, z)))
    top = math.floor((0.5 - (latitude + reach) / math.pi) * height)
    bottom = math.ceil((0.5 - (latitude - reach) / math.pi) * height)
    rows = max(0, top), min(height, bottom)
    if abs(latitude) + reach >= math.pi / 2:
        return rows, (0, width)
    spread = math.asin(math.sin(reach) / math.cos(latitude)) / (2 * math.pi) * width
    middle = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width
    first = math.floor(middle - spread) - 1
    return rows, (first % width, min(width, math.ceil(2 * spread) + 3))
