"""Points of a panorama from three sides, for one or more depth images of it.

``python -m studies.point_views points.jpg room.png true_depth.png depth.png`` draws a row for
each depth image: the floor plan, and the halves of the room ahead and to the left. ``--titles``
are the titles of the rows, by default the names of the files.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_directions, to_right_handed
from tangent_train.io.pixel_files import read_depth_m

SIDE = 320
"""Rows and columns of a view."""

_HEAD_M = 0.6  # the floor plan leaves out the ceiling, and the sides what is behind the camera
_BEHIND_M = -0.2


def drawn(
    points: NDArray[np.floating], colors: NDArray[np.uint8], half_m: float
) -> NDArray[np.uint8]:
    """Draw the three orthographic views of a point cloud side by side.

    Args:
        points: ``(n, 3)`` meters: x ahead, y left, z up.
        colors: ``(n, 3)`` colors.
        half_m: Half of the extent of a view in meters.
    """
    x, y, z = points.T
    sides = ((-y, -x, z, z < _HEAD_M), (-y, -z, -x, x > _BEHIND_M), (x, -z, -y, y > _BEHIND_M))
    views = []
    for right, down, nearness, shown in sides:
        view = np.full((SIDE, SIDE, 3), 255, np.uint8)
        order = np.flatnonzero(shown)[np.argsort(nearness[shown])]  # near points are drawn last
        place = (np.stack([down, right])[:, order] / half_m + 1) * SIDE / 2
        inside = ((place >= 0) & (place < SIDE - 1)).all(axis=0)
        rows, columns = place[:, inside].astype(int)
        for i, j in ((1, 1), (1, 0), (0, 1), (0, 0)):  # points of 2 × 2 pixels
            view[rows + i, columns + j] = colors[order[inside]]
        views.append(view)
    return np.hstack(views)


def titled(rows: Mapping[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Put rows of views below each other, with their titles.

    Args:
        rows: Views side by side, see `drawn`, by title.
    """
    font, black = cv2.FONT_HERSHEY_SIMPLEX, (0, 0, 0)
    parts = []
    for title, row in rows.items():
        strip = np.full((56, row.shape[1], 3), 255, np.uint8)
        cv2.putText(strip, title, (6, 20), font, 0.6, black, 1, cv2.LINE_AA)
        for k, name in enumerate(("floor plan", "ahead", "to the left")):
            cv2.putText(strip, name, (6 + k * SIDE, 48), font, 0.45, black, 1, cv2.LINE_AA)
        filled = np.flatnonzero((row < 255).any(axis=(1, 2)))
        parts += [strip, row[filled[0] : filled[-1] + 1], np.full_like(strip[:16], 255)]
    return np.vstack(parts)


def main() -> None:
    """Read the files and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", metavar="<picture>")
    parser.add_argument("panorama", metavar="<panorama>")
    parser.add_argument("depth", type=Path, nargs="+", metavar="<depth>")
    parser.add_argument("--depth_scale", type=float, default=1000, help="units per meter")
    parser.add_argument("--titles", nargs="+", help="of the rows")
    arguments = parser.parse_args()
    bgr: Any = cv2.imread(arguments.panorama)
    rgb = bgr[..., ::-1]
    rays = to_right_handed(equirect_directions(rgb.shape[:2]))
    depths = [read_depth_m(path, arguments.depth_scale) for path in arguments.depth]
    clouds = [rays * np.where(depth > 0, depth, np.nan)[..., None] for depth in depths]
    half_m = 1.05 * float(np.nanpercentile(np.abs(clouds[0]), 99.9))
    rows = [drawn(cloud.reshape(-1, 3), rgb.reshape(-1, 3), half_m) for cloud in clouds]
    titles = arguments.titles or [path.stem for path in arguments.depth]
    picture = titled(dict(zip(titles, rows, strict=True)))
    cv2.imwrite(arguments.output, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
