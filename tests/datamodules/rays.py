"""Rays and triangles, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def hit_distances(origins: Any, rays: NDArray[np.float64], triangles: Any) -> NDArray[np.float64]:
    """Distances ``(n, m)`` at which n rays meet m triangles (Möller and Trumbore), or infinity."""
    corner, b, c = np.moveaxis(np.asarray(triangles, np.float64), 1, 0)
    away = np.broadcast_to(origins, rays.shape)[:, None] - corner
    p, q = np.cross(rays[:, None], c - corner), np.cross(away, b - corner)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (p * (b - corner)).sum(axis=-1)
        u, v = (p * away).sum(axis=-1) * inverse, (q * rays[:, None]).sum(axis=-1) * inverse
        distances = (q * (c - corner)).sum(axis=-1) * inverse
        hit = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (distances > 0)
    return np.where(hit, distances, np.inf)
