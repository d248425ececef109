"""Cube maps: the six faces of a cube, a baseline for tangent images."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tangent_train.errors import at_least
from tangent_train.geometry.pinhole_grid import PinholeGrid

_X, _Y, _Z = np.eye(3)

_FACES = [  # right, down, forward
    (_Y, -_Z, _X),
    (-_X, -_Z, _Y),
    (-_Y, -_Z, -_X),
    (_X, -_Z, -_Y),
    (_Y, _X, _Z),
    (_Y, -_X, -_Z),
]
_AXES = np.array(_FACES).swapaxes(1, 2)


class CubeGrid(PinholeGrid):
    """The six faces of a cube around the center, pinhole images of 90°, or more with a margin.

    The faces are in this order: front (+x, the middle of the panorama), right (+y), back (−x),
    left (−y), up (+z) and down (−z). The first four stand upright. Up and down are the front
    camera tilted up and down: columns grow to +y in both, rows towards the front (+x) in up and
    towards the back (−x) in down, so that up fits above and down below the front, as in a cross of
    unfolded faces.

    The outer *edges* of neighboring images meet: d pixels span the 90°, the pitch is ``p = 2/d``
    and the outermost pixel centers are half a pixel inside. The images do not overlap; the
    directions that a face owns reach half a pixel beyond its outermost pixel centers. With a
    margin m on every side, d − 2m pixels span the 90°, and the images overlap.
    `fov_deg`, between pixel centers as everywhere, is a little less than the 70.5° between adjacent
    corners of the cube.

    Args:
        dim: Side d in pixels, 2 or more; 2^s is 90° of a panorama of level s.
        rotation: ``(3, 3)`` proper rotation R of the whole cube: directions become R·d.
        margin: Pixels beyond the 90° on every side.

    Raises:
        SettingError: The side is too small or not an integer, or the rotation is not a rotation.

    >>> grid = CubeGrid(dim=32)
    >>> grid.num_images, grid.pitch, grid.half_extent
    (6, 0.0625, 0.96875)
    """

    def __init__(self, dim: int, rotation: ArrayLike | None = None, margin: int = 0) -> None:
        margin = at_least("margin", margin, 0)
        dim = at_least("dim", dim, 2 + 2 * margin)
        pitch = 2 / (dim - 2 * margin)
        # Without a margin, neighbors meet at their outer edges.
        super().__init__(_AXES, (dim, dim), pitch, rotation, is_overlapping=margin > 0)
