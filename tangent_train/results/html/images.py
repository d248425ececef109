"""Compressed panoramas and photos of a report, within a byte budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_solid_angles

__all__ = ["BUDGET_BYTES", "MOST_PIXELS", "EncodedImage", "encode_image"]

BUDGET_BYTES = 8_000_000
"""Of the HTML file, for one image with its label maps."""

MOST_PIXELS = 4096
"""The longer side of an image in the report."""

_THUMBNAIL_PIXELS = 216
_QUALITY = 88


@dataclass(frozen=True)
class EncodedImage:
    """A compressed image of the viewer, with its label maps; see `encode_image`.

    Attributes:
        name: Shown beside it.
        note: A line about it, such as a score.
        sphere: Whether it is a whole equirectangular panorama; others are shown flat.
        width: Columns of the image before it was compressed.
        height: Rows of the image before it was compressed.
        jpeg: The image.
        thumbnail: A small JPEG of it.
        prediction: 8-bit grey PNG of class indices, perhaps of fewer pixels.
        truth: Likewise.
        shares: ``(class index, share of the truth, share of the prediction)``, without the maps
            that are missing, of the classes that appear; by solid angle on panoramas.
    """

    name: str
    note: str
    sphere: bool
    width: int
    height: int
    jpeg: bytes
    thumbnail: bytes
    prediction: bytes | None
    truth: bytes | None
    shares: tuple[tuple[float, ...], ...]


def encode_image(
    name: str,
    rgb: NDArray[np.uint8],
    class_count: int,
    *,
    prediction: NDArray[np.integer] | None = None,
    truth: NDArray[np.integer] | None = None,
    sphere: bool = True,
    note: str = "",
    budget_bytes: int = BUDGET_BYTES,
) -> EncodedImage:
    """Compress an image to its share of the report.

    Sides longer than `MOST_PIXELS` are downsampled, colours by area, labels by nearest neighbour,
    then halved until they fit.

    Args:
        name: Shown beside it.
        rgb: ``(H, W, 3)`` the image.
        class_count: K + 1, the unknown class 0 included; at most 256.
        prediction: ``(h, w)`` class indices, 0 where there is none; of any size.
        truth: ``(h, w)`` class indices, 0 unknown; of any size.
        sphere: Whether it is a whole equirectangular panorama.
        note: A line about it.
        budget_bytes: Of the HTML file, where files are written in base64.
    """
    maps = {"truth": truth, "prediction": prediction}
    labels = {k: v.astype(np.uint8, copy=False) for k, v in maps.items() if v is not None}
    thumbnail = _jpeg(_shrunk(rgb, _THUMBNAIL_PIXELS, cv2.INTER_AREA))
    room, side = budget_bytes * 3 // 4 - len(thumbnail), MOST_PIXELS
    while True:
        small = {k: _shrunk(v, side, cv2.INTER_NEAREST_EXACT) for k, v in labels.items()}
        pngs = {k: _encoded(".png", v, [cv2.IMWRITE_PNG_COMPRESSION, 6]) for k, v in small.items()}
        jpeg = _jpeg(_shrunk(rgb, side, cv2.INTER_AREA))
        if len(jpeg) + sum(map(len, pngs.values())) <= room or side == 1:
            break
        side //= 2
    return EncodedImage(
        name=name,
        note=note,
        sphere=sphere,
        width=rgb.shape[1],
        height=rgb.shape[0],
        jpeg=jpeg,
        thumbnail=thumbnail,
        prediction=pngs.get("prediction"),
        truth=pngs.get("truth"),
        shares=_shares(list(small.values()), class_count, sphere=sphere),
    )


def _shrunk(pixels: NDArray[np.uint8], side: int, interpolation: int) -> NDArray[np.uint8]:
    """With a longer side of at most `side` pixels."""
    scale = side / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    height, width = (max(1, round(length * scale)) for length in pixels.shape[:2])
    resized: Any = cv2.resize(pixels, (width, height), interpolation=interpolation)
    return resized


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return _encoded(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def _encoded(suffix: str, pixels: Any, settings: Sequence[int]) -> bytes:
    return bytes(cv2.imencode(suffix, pixels, settings)[1])


def _shares(
    maps: Sequence[NDArray[np.uint8]], class_count: int, *, sphere: bool
) -> tuple[tuple[float, ...], ...]:
    shares = [_class_shares(indices, class_count, sphere=sphere) for indices in maps]
    return tuple(
        (index, *(float(share[index]) for share in shares))
        for index in range(class_count)
        if any(share[index] > 0 for share in shares)
    )


def _class_shares(
    indices: NDArray[np.uint8], class_count: int, *, sphere: bool
) -> NDArray[np.float64]:
    height, width = indices.shape
    weights = equirect_solid_angles((height, width)) if sphere else np.ones(height)
    # Row by row: no array of weights as large as the image.
    counts = np.stack([np.bincount(row, minlength=class_count) for row in indices])
    weighed: NDArray[np.float64] = weights.reshape(-1) @ counts
    return weighed / weighed.sum()
