"""Point clouds as binary PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tangent_train.files import write_bytes


def write_points(
    path: Path,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    normals: NDArray[np.floating] | None = None,
) -> None:
    """Write a point cloud atomically.

    Args:
        path: PLY file.
        points: ``(n, 3)``, written as float32.
        colors: ``(n, 3)`` RGB.
        normals: ``(n, 3)`` unit vectors, 0 where unknown; None to write none.
    """
    given = {"x y z": points, "nx ny nz": normals, "red green blue": colors}
    columns = {name: v for name, v in given.items() if v is not None}
    kinds = {
        name: ("u1", "uchar") if v is colors else ("<f4", "float") for name, v in columns.items()
    }
    fields = [(one, *kinds[name]) for name in columns for one in name.split()]
    table = np.empty(len(points), [(name, code) for name, code, _ in fields])
    for name, values in columns.items():
        for one, column in zip(name.split(), values.T, strict=True):
            table[one] = column
    properties = "".join(f"property {kind} {name}\n" for name, _, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}"
    write_bytes(path, f"{header}end_header\n".encode() + table.tobytes())
