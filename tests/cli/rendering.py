"""``tangent-render`` in this process, and a panorama to render."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf

from tangent_train.cli.render import render
from tangent_train.files import config_folder
from tangent_train.geometry import equirect_directions

Refused = Callable[..., str]
"""Messages of a rendering that is refused, or of which some panoramas fail."""


def render_with(**settings: Any) -> None:
    """Run the command; other settings have their defaults."""
    config = OmegaConf.load(config_folder() / "render.yaml")
    texts = {
        key: str(value) if isinstance(value, Path) else value for key, value in settings.items()
    }
    assert not texts.keys() - set(config)
    plain: Any = OmegaConf.to_container(OmegaConf.merge(config, texts), resolve=True)
    render(plain)


def smooth(height: int = 64) -> NDArray[np.uint8]:
    """``(H, 2H, 3)`` RGB, smooth on the sphere; every direction has its own color."""
    return np.rint((equirect_directions((height, 2 * height)) + 1) * 127.5).astype(np.uint8)
