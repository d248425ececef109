from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

from datamodules.synthrooms.generate import generate_rooms
from datamodules.synthrooms.settings import RoomSettings
from datamodules.synthshapes.generate import ShapeSettings, generate_shapes

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

STRIPS = 4
TINY_ROOMS = RoomSettings(
    seed=3,
    rooms={"1": 2, "5a": 1, "5b": 1},
    height=16,
    views_per_camera=1,
    view_size=8,
    supersample=1,
)
TINY_SHAPES = ShapeSettings(seed=3, train=2, test=1)


@dataclass(frozen=True)
class StripViews:
    """Vertical strips of the panorama after a roll."""

    strips: tuple[int, ...]
    shift: int = 0

    def render(
        self, image: NDArray[Any], interpolation: Literal["bilinear", "nearest"]
    ) -> NDArray[Any]:
        # Colours may be interpolated; depth and labels never.
        assert (interpolation == "bilinear") is (image.ndim == 3)
        parts = np.split(np.roll(image, self.shift, axis=1), STRIPS, axis=1)
        return np.stack([parts[i] for i in self.strips])

    def rays(self) -> NDArray[np.float32]:
        return np.zeros((0, 3, 3), np.float32)

    def rotations(self) -> NDArray[np.float64]:
        return np.eye(3)[None]


@dataclass(frozen=True)
class StripRepresentation:
    """The simplest representation: quarters of the panorama, two of them while training."""

    erp_height: int = 16

    @property
    def image_size(self) -> tuple[int, int]:
        return self.erp_height, 2 * self.erp_height // STRIPS

    def sample(self, rng: np.random.Generator) -> StripViews:
        strips = rng.choice(STRIPS, 2, replace=False)
        return StripViews(tuple(map(int, strips)), int(rng.integers(2 * self.erp_height)))

    def whole(self) -> StripViews:
        return StripViews(tuple(range(STRIPS)))

    def turned(self, rotation: NDArray[np.float64]) -> StripRepresentation:
        raise NotImplementedError

    def to_labels(
        self, scores: Any, shape: tuple[int, int], rotations: NDArray[np.float64] | None = None
    ) -> Any:
        raise NotImplementedError


@pytest.fixture
def strips() -> StripRepresentation:
    return StripRepresentation()


@pytest.fixture(scope="session")
def tiny_rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rooms of `TINY_ROOMS`; not to be changed."""
    root = tmp_path_factory.mktemp("data") / "rooms"
    generate_rooms(root, TINY_ROOMS, workers=0, progress=False)
    return root


@pytest.fixture(scope="session")
def tiny_shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shapes of `TINY_SHAPES`; not to be changed."""
    root = tmp_path_factory.mktemp("data") / "shapes"
    generate_shapes(root, TINY_SHAPES, workers=0, progress=False)
    return root
