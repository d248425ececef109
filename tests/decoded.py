"""Pixels of encoded images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def decoded(content: bytes | None) -> NDArray[np.uint8]:
    """``(H, W, 3)`` RGB or ``(H, W)`` gray pixels of an encoded image, without transparency."""
    assert content is not None
    pixels: Any = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_ANYCOLOR)
    assert pixels is not None
    return pixels if pixels.ndim == 2 else pixels[..., ::-1]
