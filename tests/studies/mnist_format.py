"""Files in MNIST's format, small."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["idx", "write_mnist"]


def idx(values: NDArray[np.uint8]) -> bytes:
    head = struct.pack(f">BBBB{values.ndim}I", 0, 0, 8, values.ndim, *values.shape)
    return head + values.tobytes()


def write_mnist(
    folder: Path, train: int = 40, test: int = 20, *, packed: bool = False, style: str = "-idx"
) -> dict[str, NDArray[np.uint8]]:
    """Bars whose place is their class, in noise; returns what is in each file."""
    rng = np.random.default_rng(7)
    folder.mkdir(parents=True)
    content: dict[str, NDArray[np.uint8]] = {}
    for part, count in (("train", train), ("t10k", test)):
        labels = (np.arange(count) % 10).astype(np.uint8)
        images = rng.integers(0, 60, (count, 28, 28), np.uint8)
        for image, label in zip(images, labels, strict=True):
            image[4 + 2 * label : 6 + 2 * label, 6:22] = 255
        content |= {f"{part}-images{style}3-ubyte": images, f"{part}-labels{style}1-ubyte": labels}
    for name, values in content.items():
        data = idx(values)
        path = folder / (f"{name}.gz" if packed else name)
        path.write_bytes(gzip.compress(data) if packed else data)
    return content
