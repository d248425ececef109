"""``tangent-render`` in this process, and a panorama to render."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.cli.render import render
from tangent_train.config.settings import validate
from tangent_train.geometry import equirect_directions

Refused = Callable[..., str]
"""Messages of a rendering that is refused, or of which some panoramas fail."""


def render_with(**settings: Any) -> None:
    """Run the command; other settings have their defaults."""
    texts = {name: str(v) if isinstance(v, Path) else v for name, v in settings.items()}
    render(validate("render", texts))


def smooth(height: int = 64) -> NDArray[np.uint8]:
    """``(H, 2H, 3)`` RGB, smooth on the sphere; every direction has its own color."""
    return np.rint((equirect_directions((height, 2 * height)) + 1) * 127.5).astype(np.uint8)
