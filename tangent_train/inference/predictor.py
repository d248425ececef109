"""What predictors of panoramas and of photos share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from datamodules.core.samples import normalize, render_inputs, world_rays
from models.held import held_networks
from models.sphere_context import SphereContext
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering.mosaic import ScoreMosaic
    from tangent_train.rendering.representations.views import Views

__all__ = ["Done", "InputImage", "Level", "Prediction", "Runner"]

Level = int | Literal["image"] | None
"""Level s the network sees: a number, that of each image's rows, or (None) as trained."""

Done = Callable[[float], None]
"""Is told what share of an image has been done since the last time."""

_FORMAT: Any = torch.channels_last
"""Of images and network: half the time of a UNet on a CPU."""

_PIXELS_AT_ONCE = 2**20
"""Pixels the network sees at once, if nothing else is asked for."""


@dataclass(frozen=True)
class InputImage:
    """A panorama of the whole sphere, or a photo.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` distance from the centre in steps of 1/512 m, 0 where missing; or None.
        up: ``(3,)`` direction of the zenith of a panorama; None where it is z.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None = None
    up: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Prediction:
    """The scores of one image.

    Attributes:
        mosaic: The scores; class k of them is label k + 1.
        level: Level s the network saw.
        views: Images it saw.
        grid: The images of a panorama, not turned; None where borders between them do not exist.
    """

    mosaic: ScoreMosaic
    level: int
    views: int
    grid: PinholeGrid | None = None


class Runner:
    """Shows a network views of an image, a few at a time.

    Args:
        trained: The network; it is moved to the device.
        device: Where it runs.
        views_at_once: A bound on memory; None for as many as fit 2^20 pixels.

    Raises:
        SettingError: There is no such device, or no view at once.
    """

    def __init__(
        self, trained: TrainedNetwork, device: str = "cpu", views_at_once: int | None = None
    ) -> None:
        if views_at_once is not None and views_at_once < 1:
            raise SettingError("images_per_forward", found=views_at_once, expected="1 or more")
        try:
            self._device = torch.device(device)
            self._network = trained.network.to(self._device).to(memory_format=_FORMAT)
        except (RuntimeError, AssertionError) as error:  # torch says so when it lacks CUDA
            raise SettingError(
                "device", found=f"{device} ({error})", expected="cpu, or a device of this machine"
            ) from error
        held = held_networks(getattr(self._network, "network", self._network))  # in `Scores`
        self._of_sphere = next((n for n in held if isinstance(n, SphereContext)), None)
        self._normalization = trained.normalization
        self._inputs = trained.inputs
        self._at_once = views_at_once
        self.num_classes = len(trained.class_names) - 1

    def parts(self, count: int, size: tuple[int, int]) -> list[NDArray[np.int64]]:
        """Numbers of the views to show together, of images of this size."""
        step = self._at_once or max(1, _PIXELS_AT_ONCE // (size[0] * size[1]))
        return [np.arange(start, min(start + step, count)) for start in range(0, count, step)]

    @torch.inference_mode()
    def contexts(self, image: InputImage, views: Sequence[Views]) -> list[Tensor | None]:
        """What views of one sphere learn from each other, for `scores`.

        Args:
            image: The panorama.
            views: All of the sphere, in parts that are shown together.

        Returns:
            For each part; None where the network looks at every image alone.
        """
        network = self._of_sphere
        if network is None:
            return [None] * len(views)
        tokens = [network.encode(self._images(image, part)) for part in views]
        rays = torch.from_numpy(np.concatenate([world_rays(part, image.up) for part in views]))
        context = network.mix(rays[None].to(self._device), torch.cat(tokens))
        return list(torch.split(context, [len(part) for part in tokens]))

    @torch.inference_mode()
    def scores(self, image: InputImage, views: Views, context: Tensor | None = None) -> Tensor:
        """``(n, K, h, w)`` scores of the views; the unknown class, never predicted, is left out.

        Args:
            image: A panorama or photo.
            views: Some that are shown together.
            context: Theirs, from `contexts`.
        """
        images = self._images(image, views)
        if self._of_sphere is None or context is None:
            scores: Tensor = self._network(images)
        else:
            scores = self._of_sphere.decode(images, context)
        return scores[:, 1:]

    def _images(self, image: InputImage, views: Views) -> Tensor:
        rendered = [part.to(self._device) for part in render_inputs(image, views, self._inputs)]
        images = normalize(rendered, self._normalization, self._inputs)
        return images.contiguous(memory_format=_FORMAT)
