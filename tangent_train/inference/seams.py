"""How much the borders between tangent images show in labels."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tangent_train.geometry import equirect_latitudes
from tangent_train.rendering.kernels import directions_of_rows
from tangent_train.rendering.tables import owner_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.geometry import PinholeGrid

__all__ = ["SeamScore", "seam_score"]

_MOST_ROWS = 2048
"""Of taller panoramas, every second row and column is looked at, or every fourth, …"""


class SeamScore(NamedTuple):
    """How often neighbouring pixels have different labels.

    Attributes:
        border: Share of the pairs on both sides of a border between two images.
        inside: Share of the pairs inside one image.
    """

    border: float
    inside: float

    @property
    def ratio(self) -> float:
        """1 where borders do not show; NaN where there is nothing to compare."""
        return self.border / self.inside if self.inside > 0 else float("nan")


def seam_score(labels: NDArray[np.integer], grid: PinholeGrid) -> SeamScore:
    """Disagreement across the borders of tangent images against inside.

    Pairs are neighbours in a row, across ±180° too, or in a column; each counts as its pixels'
    solid angle. Pairs with an unknown pixel do not count.

    Args:
        labels: ``(H, W)`` of the whole sphere, 0 unknown.
        grid: The images the labels were made from, not turned.

    Returns:
        Shares from 0 to 1; NaN where there are no such pairs.
    """
    step = -(-labels.shape[0] // _MOST_ROWS)
    owners = _owners(grid, (labels.shape[0], labels.shape[1]), step)
    weight = np.cos(equirect_latitudes(labels.shape[0]))[::step, None]
    labels = labels[::step, ::step]
    shape = labels.shape
    counts = np.zeros((2, 2))  # inside or border, equal or different
    for axis, last in ((1, shape[0]), (0, shape[0] - 1)):  # the rows end, the columns go around
        other, owner = np.roll(labels, -1, axis)[:last], np.roll(owners, -1, axis)[:last]
        pairs = (labels[:last] > 0) & (other > 0)
        code = 2 * (owners[:last] != owner) + (labels[:last] != other)
        weights = np.broadcast_to(weight[:last], code.shape)[pairs]
        counts += np.bincount(code[pairs], weights, minlength=4).reshape(2, 2)
    with np.errstate(invalid="ignore"):
        inside, border = counts[:, 1] / counts.sum(axis=1)
    return SeamScore(float(border), float(inside))


def _owners(grid: PinholeGrid, shape: tuple[int, int], step: int) -> NDArray[np.integer]:
    """Owners of every `step`-th row and column of a panorama."""
    if step == 1:
        return owner_table(grid, shape, np.dtype(np.float32)).face[0]
    columns, rows = directions_of_rows(*shape)
    columns, rows = columns[::step], rows[::step]
    owners = np.empty((len(rows), len(columns)), np.int32)
    for owner, (cosine, sine) in zip(owners, rows, strict=True):
        directions = np.column_stack([cosine * columns, np.full(len(columns), sine)])
        owner[:] = grid.owners(directions)
    return owners
