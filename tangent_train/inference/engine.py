"""The engine: images → views → network → mosaic → labels.

A representation selects the views of an image. The engine renders them, or takes rendered views
from the loader, passes them to the network a few at a time, and adds the scores to a mosaic.
Images, views, scores and mosaic are on one device. Validation, test, prediction, transfer, `load`
and `UpLikelihood` use the engine.
"""

from __future__ import annotations

import inspect
import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from datamodules.core.dataset import render_inputs
from datamodules.core.depth import STEPS_PER_M, resize_depth
from datamodules.core.inputs import MAX_DEPTH_M, normalize
from tangent_train.checkpoints.outputs import OutputNetwork, network_for_views, plain_output
from tangent_train.errors import SettingError, at_least
from tangent_train.rendering.resampling import resize
from tangent_train.rendering.sampling import sphere_rays

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray
    from torch import Tensor, nn

    from datamodules.core.inputs import Input
    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.heads import Head
    from tangent_train.inference.images import InputImage
    from tangent_train.inference.views import PanoramaViews, PhotoViews
    from tangent_train.rendering import Interpolation
    from tangent_train.rendering.representations.views import Views

    ViewImages = Callable[[slice], Tensor]
    """Returns some of the views as normalized images ``(n, C, h, w)``."""

    ViewSet = tuple[Views, ViewImages, Tensor | None]
    """Views that cover the whole image, their images, and rays if the network takes them."""

_PIXELS_PER_FORWARD = 2**20


def sees_rays(network: nn.Module) -> bool:
    """Return True if a network takes viewing rays, such as one with cross-image attention."""
    inner = network.network if isinstance(network, OutputNetwork) else network
    return "rays" in inspect.signature(inner.forward).parameters


def views_per_forward(image_size: tuple[int, int]) -> int:
    """Return the number of views of a size in one call of a network, which limits memory."""
    return max(1, _PIXELS_PER_FORWARD // math.prod(image_size))


@torch.no_grad()
def view_scores(
    network: Callable[..., Any],
    images: ViewImages,
    count: int,
    per_forward: int,
    rays: Tensor | None = None,
) -> Iterator[tuple[slice, Tensor]]:
    """Compute the scores of the views of one image, a few views at a time.

    Args:
        network: Maps images ``(n, C, h, w)`` to scores ``(n, K, h, w)``, or to a dict that contains
            them under ``"out"``.
        images: Function that returns views.
        count: Number of views N.
        per_forward: Number of views per call of the network.
        rays: ``(N, 3, 3)`` viewing rays, see `Views.rays`, for networks with cross-image attention.
            These are called once, with all views: ``network(images, rays[None])``.

    Yields:
        A slice of the views and their float32 scores ``(n, K, h, w)``.
    """
    step = per_forward if rays is None else count
    for start in range(0, count, step):
        part = slice(start, min(start + step, count))
        returned = network(images(part), *(() if rays is None else (rays[None],)))
        yield part, plain_output(returned).float()


def scored_views(
    network: Callable[..., Any], sets: Iterable[ViewSet], per_forward: int
) -> Iterator[tuple[Views, Tensor]]:
    """Yield views of one image with their scores, a few at a time, see `view_scores`.

    Args:
        network: See `view_scores`.
        sets: Sets of views.
        per_forward: Number of views per call of the network.
    """
    for views, images, rays in sets:
        for part, scores in view_scores(network, images, len(views), per_forward, rays):
            yield views[part], scores


def upright_rays(
    sets: Iterable[Views], rotation: NDArray[np.float64] | None, device: torch.device | str
) -> Iterator[Tensor | None]:
    """Yield the viewing rays of each set of views, in a frame with its zenith at z.

    Args:
        sets: Sets of views of a panorama.
        rotation: ``(3, 3)`` rotation that aligns the views with gravity; None if they are upright.
        device: Device of the rays.
    """
    for views in sets:
        rays = views.rays()
        if rotation is not None:
            rays = rotation.T.astype(np.float32) @ rays
        yield torch.from_numpy(rays).to(device) if len(rays) else None


def input_planes(
    image: InputImage, shape: tuple[int, int], inputs: Sequence[Input], device: torch.device | str
) -> tuple[Tensor, list[tuple[Tensor, Interpolation]]]:
    """Return the inputs of a network on a device, as images of the whole panorama or photo.

    Args:
        image: The panorama or photo.
        shape: Rows and columns to which it is resized.
        inputs: Inputs of the network.
        device: A torch device.

    Returns:
        RGB ``(3, H, W)``, float32 from 0 to 255; and other inputs ``(1, H, W)`` with their
        interpolation: depth as in `render_inputs`, and elevation.
    """
    rgb = torch.from_numpy(np.ascontiguousarray(image.rgb)).to(device).movedim(-1, 0).float()
    others: list[tuple[Tensor, Interpolation]] = []
    if "depth" in inputs and image.depth is not None:
        steps = np.minimum(resize_depth(image.depth, shape), int(MAX_DEPTH_M * STEPS_PER_M))
        others.append((torch.from_numpy(steps.view(np.int16))[None].to(device), "nearest"))
    if "elevation" in inputs:
        up = np.array((0.0, 0.0, 1.0)) if image.up is None else image.up
        columns, rows = sphere_rays(shape)
        level, lines = (torch.from_numpy(a).to(device) for a in (up[:2] @ columns, rows))
        elevation = torch.outer(lines[:, 0], level) + lines[:, 1:] * float(up[2])
        others.append((elevation[None].float(), "bilinear"))
    return resize(rgb, shape, "bilinear").round_(), others


def renders_arrays(device: torch.device | str) -> bool:
    """Return True for the CPU, where OpenCV renders faster than torch."""
    return torch.device(device).type == "cpu"


class RenderedViews:
    """Renders the views of one image on a device, as inputs of a network.

    On the CPU arrays are rendered (see `render_inputs`). For other devices the image is copied to
    the device once, and tensors are rendered there.

    Args:
        loaded: The network, which is on the device.
        image: The panorama or photo.
        shape: Rows and columns to which it is resized first.
        device: A torch device.
    """

    def __init__(
        self,
        loaded: LoadedNetwork,
        image: InputImage,
        shape: tuple[int, int],
        device: torch.device | str,
    ) -> None:
        weights = next(loaded.network.parameters(), None)
        # channels_last halves the time of a UNet on a CPU; an ONNX file has a fixed format.
        contiguous = torch.contiguous_format
        self._format = contiguous if weights is None else torch.channels_last
        self._dtype = torch.float32 if weights is None else weights.dtype
        self._loaded = loaded
        arrays = renders_arrays(device)
        self._image = image.resized(shape) if arrays else image
        self._planes = None if arrays else input_planes(image, shape, loaded.inputs, device)

    def __call__(self, views: Views) -> Tensor:
        """Return normalized views ``(n, C, h, w)``."""
        inputs = self._loaded.inputs
        if self._planes is None:
            rendered = render_inputs(self._image, views, inputs)
        else:
            rgb, others = self._planes
            colors = views.render(rgb, "bilinear").round().movedim(1, -1)
            rendered = colors, *(views.render(plane, how)[:, 0] for plane, how in others)
        images = normalize(rendered, self._loaded.normalization, inputs)
        return images.to(self._dtype).contiguous(memory_format=self._format)

    def of(self, views: Views) -> ViewImages:
        """Return a function that renders some of the views."""
        return lambda part: self(views[part])


class Predictor:
    """Predicts whole panoramas or photos: passes their views to a network, a few at a time.

    Args:
        loaded: The network; it is moved to the device.
        head: The meaning of its output, see `head_of`.
        view_sets: Selects the views of an image.
        device: A torch device, or ``auto``: a GPU if there is one, else the CPU.
        view_batch_size: Number of views per call of the network, which limits memory; None for
            as many as fit into 2^20 pixels. A network with cross-image attention takes all views of
            a panorama at once, and their outputs are kept in memory.

    Attributes:
        device: Device of the network, the views and the mosaic.

    Raises:
        SettingError: The device does not exist, or `view_batch_size` is less than 1.
    """

    def __init__(
        self,
        loaded: LoadedNetwork,
        head: Head,
        view_sets: PanoramaViews | PhotoViews,
        device: str = "cpu",
        view_batch_size: int | None = None,
    ) -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.zeros(1, device=device).device  # refuses a missing device
            loaded.network.to(self.device).to(memory_format=torch.channels_last)
        except (RuntimeError, AssertionError) as error:  # AssertionError: torch without CUDA
            raise SettingError(
                "device", found=f"{device} ({error})", expected="cpu, or a device of this machine"
            ) from error
        self._per_forward = views_per_forward(view_sets.image_size)
        if view_batch_size is not None:
            self._per_forward = at_least("view_batch_size", view_batch_size, 1)
        aware = getattr(view_sets, "distortion_aware", None)
        network: Any = network_for_views(loaded.network, aware)
        self._sees_rays = sees_rays(network)
        if self._sees_rays:
            network = partial(network, view_batch_size=self._per_forward)
        self.head = head
        self._network, self._loaded, self._view_sets = network, loaded, view_sets

    @torch.no_grad()
    def predict(
        self,
        image: InputImage,
        progress: Callable[[float], object] = lambda share: None,
        *,
        averaged: bool = False,
    ) -> Any:
        """Predict one image at its own resolution.

        Args:
            image: A panorama or photo.
            progress: Called with the share of the image that was predicted since the last call.
            averaged: True if more than the pixels is needed: probabilities or confidences.

        Returns:
            The mosaic of the head, see `Head.mosaic`.
        """
        sets = self._sets(image)
        mosaic = self.head.mosaic(
            image.shape,
            self._view_sets.blend,
            averaged=averaged or len(sets) > 1,
            device=self.device,
            valid=image.valid,
            camera_matrix=image.camera_matrix,
        )
        count = sum(len(views) for views, _, _ in sets)
        for views, outputs in scored_views(self._network, sets, self._per_forward):
            mosaic.add(outputs, views)
            progress(len(views) / count)
        return mosaic

    def _sets(self, image: InputImage) -> list[ViewSet]:
        """Return the sets of views of an image."""
        sets: list[ViewSet] = []
        for shown, shape, views, rotation in self._view_sets(image):
            rendered = RenderedViews(self._loaded, shown, shape, self.device)
            rays: Iterable[Tensor | None] = [None] * len(views)
            if self._sees_rays:
                rays = upright_rays(views, rotation, self.device)
            sets += [(part, rendered.of(part), of) for part, of in zip(views, rays, strict=True)]
        return sets
