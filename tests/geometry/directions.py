"""Unit vectors and the angles between them, by other formulas than the library's."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def unit(vectors: ArrayLike) -> NDArray[np.float64]:
    """Vectors of length 1."""
    array = np.asarray(vectors, np.float64)
    return np.asarray(array / np.linalg.norm(array, axis=-1, keepdims=True))


def random_directions(count: int, seed: int = 0) -> NDArray[np.float64]:
    """``(count, 3)`` directions, uniform on the sphere."""
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def angle_deg(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Angles between vectors, precise for small ones too."""
    a, b = unit(first), unit(second)
    sines = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sines, (a * b).sum(axis=-1))))
