"""From views to class scores, and from the scores of all views to a panorama or photo."""

from __future__ import annotations

import inspect
import math
import weakref
from collections import deque
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from datamodules.core.inputs import normalize
from datamodules.core.samples import render_inputs
from tangent_train.checkpoints.scores import ClassScoreNetwork, plain_scores
from tangent_train.errors import SettingError
from tangent_train.rendering.mosaic import ScoreMosaic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray
    from torch import Tensor, nn

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.inference.views import InputImage, PanoramaViews, PhotoViews, ViewSet

_PIXELS_PER_FORWARD = 2**20


def sees_rays(network: nn.Module) -> bool:
    """Whether a network takes viewing rays, as for cross-image attention."""
    inner = network.network if isinstance(network, ClassScoreNetwork) else network
    return "rays" in inspect.signature(inner.forward).parameters


def views_per_forward(image_size: tuple[int, int]) -> int:
    """Views of that many rows and columns per call of a network, which bounds memory."""
    return max(1, _PIXELS_PER_FORWARD // math.prod(image_size))


@torch.no_grad()
def view_scores(
    network: Callable[..., Any],
    views: Callable[[slice], Tensor],
    count: int,
    per_forward: int,
    rays: Tensor | None = None,
) -> Iterator[tuple[slice, Tensor]]:
    """Scores of the views of one image, a few views at a time.

    Args:
        network: Maps images ``(n, C, h, w)`` to scores ``(n, K, h, w)``, or to a dict with these
            under ``"out"``.
        views: Gives some of the views as images, normalized.
        count: Number of views N.
        per_forward: Views per call of the network.
        rays: ``(N, 3, 3)``, see `Views.rays`, for networks with cross-image attention: they are
            called once with all views as ``network(images, rays[None])``.

    Yields:
        Some of the views and their float32 scores ``(n, K, h, w)``.
    """
    step = per_forward if rays is None else count
    for start in range(0, count, step):
        part = slice(start, min(start + step, count))
        returned = network(views(part), *(() if rays is None else (rays[None],)))
        yield part, plain_scores(returned).float()


def image_scores(
    trained: TrainedNetwork, views: ViewSet, per_forward: int, device: torch.device | str
) -> Iterator[tuple[slice, Tensor]]:
    """Scores of the views of an image, rendered a few at a time.

    Args:
        trained: The network, which is on the device.
        views: Of the image.
        per_forward: Views per call of the network, which bounds memory.
        device: A torch device.

    Yields:
        See `view_scores`.
    """
    network: Any = trained.network
    weights = next(network.parameters(), None)
    # Halves the time of a UNet on a CPU; an ONNX file takes what it was made for.
    memory_format = torch.contiguous_format if weights is None else torch.channels_last
    of_sphere = None
    if sees_rays(network):
        network = partial(network, images_per_chunk=per_forward)
        of_sphere = torch.from_numpy(views.rays).to(device) if len(views.rays) else None

    def images(part: slice) -> Tensor:
        parts = render_inputs(views.image, views.views(part), trained.inputs)
        seen = normalize([x.to(device) for x in parts], trained.normalization, trained.inputs)
        dtype = seen.dtype if weights is None else weights.dtype
        return seen.to(dtype).contiguous(memory_format=memory_format)

    return view_scores(network, images, views.count, per_forward, of_sphere)


class Predictor:
    """Predicts the class scores of whole panoramas or photos.

    Args:
        trained: The network; it is moved to the device.
        view_sets: Its views.
        device: A torch device, or ``auto``: a GPU if there is one.
        images_per_forward: Views per call of the network, which bounds memory; None for 2^20
            pixels' worth. A network with cross-image attention takes all views of a panorama
            at once, and their scores are held.
        min_confidence: Pixels whose best class has a lower probability, from 0 to 1, are unknown.

    Attributes:
        device: Where the network is.

    Raises:
        SettingError: There is no such device, or that is no probability.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        view_sets: PanoramaViews | PhotoViews,
        device: str = "cpu",
        images_per_forward: int | None = None,
        min_confidence: float = 0.0,
    ) -> None:
        if not 0 <= min_confidence <= 1:
            raise SettingError("min_confidence", found=min_confidence, expected="0 to 1")
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.zeros(1, device=device).device  # an ONNX file has nothing to move
            trained.network.to(self.device).to(memory_format=torch.channels_last)
        except (RuntimeError, AssertionError) as error:  # AssertionError: torch without CUDA
            raise SettingError(
                "device", found=f"{device} ({error})", expected="cpu, or a device of this machine"
            ) from error
        self._per_forward = images_per_forward or views_per_forward(view_sets.image_size)
        self._trained, self._view_sets = trained, view_sets
        self._min_confidence = min_confidence
        self._spare: deque[NDArray[np.float32]] = deque(maxlen=1)

    def predict(
        self,
        image: InputImage,
        progress: Callable[[float], object] = lambda share: None,
        *,
        probabilities: bool = False,
    ) -> ScoreMosaic:
        """The scores of one image at its own resolution.

        Args:
            image: A panorama or photo.
            progress: Called with the share of the image done since its last call.
            probabilities: Whether `ScoreMosaic.probabilities` is needed.

        Returns:
            The scores; score k is that of label k + 1, the last one perhaps of nothing, see
            `TrainedNetwork.groups`.
        """
        sets = self._view_sets(image)
        height, width = image.rgb.shape[:2]
        mosaic = self._mosaic((height, width), averaged=probabilities or len(sets) > 1)
        how = self._per_forward, self.device
        for views in sets:
            for part, scores in image_scores(self._trained, views, *how):
                views.add(mosaic, scores, part)
                progress((part.stop - part.start) / views.count / len(sets))
        return mosaic

    def _mosaic(self, shape: tuple[int, int], *, averaged: bool) -> ScoreMosaic:
        """A mosaic; it takes the memory of the one before, once nobody has that any more."""
        spare = None
        with suppress(IndexError):
            spare = self._spare.pop()
        mosaic = ScoreMosaic(
            shape,
            self._trained.network.num_scores,
            self._view_sets.blend,
            averaged=averaged,
            min_confidence=self._min_confidence,
            spare=spare,
        )
        if not isinstance(mosaic.sums, np.memmap):  # room on a disk is given back at once
            weakref.finalize(mosaic, self._spare.append, mosaic.sums).atexit = False
        return mosaic
