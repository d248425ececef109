"""Pixels for valid files, and files that hold them."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["DEPTH", "RGB", "SHAPE", "npy", "png"]

SHAPE = (8, 16)
_RNG = np.random.default_rng(0)
RGB: NDArray[np.uint8] = _RNG.integers(0, 256, (*SHAPE, 3), np.uint8)
DEPTH: NDArray[np.uint16] = _RNG.integers(0, 5000, SHAPE, np.uint16)


def png(pixels: NDArray[Any], **options: Any) -> bytes:
    """A PNG file."""
    file = BytesIO()
    Image.fromarray(pixels).save(file, "png", **options)
    return file.getvalue()


def npy(array: NDArray[Any]) -> bytes:
    """A file of NumPy's."""
    file = BytesIO()
    np.save(file, array)
    return file.getvalue()
