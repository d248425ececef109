"""The engine: images → views → network → mosaic → labels.

A representation selects the views of an image. The engine renders them, or takes rendered views
from the loader, passes them to the network a few at a time, and adds the scores to a mosaic.
Images, views, scores and mosaic are on one device. Validation, test, prediction, transfer, `load`
and `UpLikelihood` use the engine.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.utils._pytree import tree_map_only

from datamodules.core.dataset import render_inputs
from datamodules.core.depth import STEPS_PER_M, resize_depth
from datamodules.core.inputs import MAX_DEPTH_M, normalize
from models.distortion_aware import make_ordinary
from tangent_train.checkpoints.outputs import named_outputs, network_for_views
from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, random_rotation, rotation_about
from tangent_train.geometry.sphere import equirect_elevations
from tangent_train.heads.base import PredictedImage
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.metrics.scores import TURNS
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering import CubemapRepresentation
from tangent_train.rendering.resampling import resize
from tangent_train.rendering.tensors import on_device

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.heads import Head
    from tangent_train.rendering.representations.views import Views

    ViewImages = Callable[[slice], Tensor]
    """Returns some of the views as normalized images ``(n, C, h, w)``."""

    ViewSet = tuple[Any, ViewImages, Tensor | None]
    """Views that cover the whole image, a `Views` or `range`; their images; and rays if the network
    takes cameras."""

_PIXELS_PER_FORWARD = 2**20

_FOV_DEG = 135.0  # the corners show ceiling and floor, which reveal a wrong direction
_EXPONENT = 3.0  # fitted to real panoramas of one home, and to synthetic rooms
_COUNTED = 20  # more, smaller views do not add evidence
_LEAST = 1e-4


def views_per_forward(image_size: tuple[int, int]) -> int:
    """Return the number of views of a size in one call of a network, which limits memory."""
    return max(1, _PIXELS_PER_FORWARD // math.prod(image_size))


@torch.no_grad()
def scored_views(
    network: Callable[..., Any], sets: Iterable[ViewSet], per_forward: int, joins: bool = False
) -> Iterator[tuple[Any, Tensor, Mapping[str, Tensor]]]:
    """Yield views of one image with their scores, a few at a time.

    Args:
        network: Maps images ``(n, C, h, w)`` to scores ``(n, K, h, w)``, or to a dict that contains
            them under ``"out"``, and for depth optionally ``"confidence"`` ``(n, 1, h, w)``. A
            network that takes cameras is called once for a set with rays, with all views:
            ``network(images, rays[None])``.
        sets: Sets of views.
        per_forward: Number of views per call of the network.
        joins: True to call the network once for all sets, see `OutputNetwork`.

    Yields:
        Views; their float32 scores ``(n, K, h, w)``, with the confidence as the last channel; and
        all outputs of the network by name.
    """
    if joins:
        given = list(sets)
        whole = torch.cat([read(slice(0, len(views))) for views, read, _ in given])
        known = [of for _, _, of in given if of is not None]
        returned = network(whole, torch.cat(known)[None]) if known else network(whole)
        scores, outputs = _with_confidence(returned)
        starts = np.cumsum([0, *(len(views) for views, _, _ in given)])
        for (views, _, _), start in zip(given, starts, strict=False):
            yield views, scores[start : start + len(views)], outputs
        return
    for views, images, rays in sets:
        step = per_forward if rays is None else len(views)
        for start in range(0, len(views), step):
            part = slice(start, min(start + step, len(views)))
            returned = network(images(part), *(() if rays is None else (rays[None],)))
            yield views[part], *_with_confidence(returned)


def _with_confidence(returned: Any) -> tuple[Tensor, Mapping[str, Tensor]]:
    """Return float32 scores, with a confidence as the last channel, and all outputs by name."""
    outputs = named_outputs(returned)
    scores = outputs["out"]
    if "confidence" in outputs:
        scores = torch.cat([scores, outputs["confidence"]], dim=1)
    return scores.float(), outputs


def add_views(mosaic: Any, views: Any, scores: Tensor, outputs: Mapping[str, Any]) -> None:
    """Add scores and objects of some views, see `scored_views`, to the mosaic of a head."""
    mosaic.add(scores, views)
    if "segments" in outputs and hasattr(mosaic, "add_segments"):
        mosaic.add_segments(outputs["segments"], views)


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
        self._loaded, self._device = loaded, device
        self._arrays = renders_arrays(device)
        self._image = image.resized(shape) if self._arrays else image
        self._panorama = torch.empty(0) if self._arrays else self._normalized(shape)
        self._rendered: tuple[Views | None, Tensor] = None, self._panorama

    def _normalized(self, shape: tuple[int, int]) -> Tensor:
        """Return the normalized inputs of the whole image on the device, ``(C, H, W)``."""
        image, inputs, device = self._image, self._loaded.inputs, torch.device(self._device)
        rgb = on_device(image.rgb, device).movedim(-1, 0)
        if image.shape != shape:
            rgb = resize(rgb.float(), shape, "bilinear")
        planes = [rgb.movedim(0, -1)]
        if "depth" in inputs and image.depth is not None:
            steps = np.minimum(resize_depth(image.depth, shape), int(MAX_DEPTH_M * STEPS_PER_M))
            planes.append(on_device(steps.view(np.int16), device))
        if "elevation" in inputs:
            up = np.array((0.0, 0.0, 1.0)) if image.up is None else image.up
            planes.append(on_device(equirect_elevations(shape, up), device))
        return normalize(planes, self._loaded.normalization, inputs)

    def __call__(self, views: Views) -> Tensor:
        """Return normalized views ``(n, C, h, w)``."""
        inputs = self._loaded.inputs
        if self._arrays:
            rendered = render_inputs(self._image, views, inputs)
            images = normalize(rendered, self._loaded.normalization, inputs)
            return images.to(self._dtype, memory_format=self._format)
        if "depth" not in inputs:
            return views.render(self._panorama, "bilinear").to(self._dtype)
        colors, depth, elevations = self._panorama.tensor_split((3, 4))
        parts = [views.render(colors, "bilinear"), views.render(depth, "nearest")]
        if len(elevations):
            parts.append(views.render(elevations, "bilinear"))
        return torch.cat(parts, dim=1).to(self._dtype)

    def of(self, views: Views) -> ViewImages:
        """Return a function that renders some of the views; on a GPU all at the first call."""
        if self._arrays:
            reduced = copy.copy(self)
            reduced._image = replace(self._image, rgb=views.reduced(self._image.rgb))
            return lambda part: reduced(views[part])
        return partial(self._part, views)

    def _part(self, views: Views, part: slice) -> Tensor:
        if self._rendered[0] is not views:  # one set at a time is kept
            self._rendered = views, self(views)
        return self._rendered[1][part]


class Predictor:
    """Predicts whole panoramas or photos: passes their views to a network, a few at a time.

    Args:
        loaded: The network; it is moved to the device.
        head: The meaning of its output, see `head_of`.
        views: Selects the views of an image.
        device: A torch device, or ``auto``: a GPU if there is one, else the CPU.
        view_batch_size: Number of views per call of the network, which limits memory; None for
            as many as fit into 2^20 pixels. The outputs of a network that takes cameras are kept in
            memory for all views of a panorama.
        compile: Arguments of `torch.compile`, empty for its defaults; None to disable it.

    Attributes:
        device: Device of the network, the views and the mosaic.

    Raises:
        SettingError: The device does not exist.
    """

    def __init__(
        self,
        loaded: LoadedNetwork,
        head: Head,
        views: ViewSelector,
        device: str | int | torch.device = "cpu",
        view_batch_size: int | None = None,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
    ) -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.zeros(1, device=device).device  # with the number of a GPU
        except (RuntimeError, AssertionError) as error:  # AssertionError: torch without CUDA
            expected = "cpu, or a device of this machine"
            raise SettingError("device", found=f"{device} ({error})", expected=expected) from error
        loaded.network.to(self.device).to(memory_format=torch.channels_last)
        self.head = head
        self._loaded, self._views, self._view_batch_size = loaded, views, view_batch_size
        self._compile = compile
        self._takes_cameras = bool(getattr(loaded.network, "takes_cameras", False))

    @cached_property
    def _network_of_panoramas(self) -> Any:
        aware = getattr(self._views.representation, "distortion_aware", None)
        return self._compiled(network_for_views(self._loaded.network, aware))

    @cached_property
    def _network_of_photos(self) -> Any:
        return self._compiled(self._loaded.network)

    def _compiled(self, network: Any) -> Any:
        if self._compile is None:
            return network
        compiled: Any = torch.compile(network, **self._compile)
        # The next call of a CUDA graph overwrites the output of the last.
        return lambda *given, **named: tree_map_only(
            torch.Tensor, torch.clone, dict(named_outputs(compiled(*given, **named)))
        )

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
        sets: list[ViewSet] = []
        for source, shape, views, rotation in self._views(image):
            rendered = RenderedViews(self._loaded, source, shape, self.device)
            rays: Iterable[Tensor | None] = [None] * len(views)
            if self._takes_cameras:
                rays = upright_rays(views, rotation, self.device)
            sets += [(part, rendered.of(part), of) for part, of in zip(views, rays, strict=True)]
        mosaic = self.head.mosaic(
            image.shape,
            self._views.blend(image),
            averaged=averaged or len(sets) > 1,
            device=self.device,
            valid=image.valid,
            camera_matrix=image.camera_matrix,
        )
        per_forward = self._view_batch_size or views_per_forward(self._views.image_size(image))
        network = self._network_of_panoramas if image.is_panorama else self._network_of_photos
        if self._takes_cameras:
            network = partial(network, view_batch_size=per_forward)
        count = sum(len(views) for views, _, _ in sets)
        joins = getattr(self._loaded.network, "takes_all_views", False)
        for views, scores, outputs in scored_views(network, sets, per_forward, joins):
            add_views(mosaic, views, scores, outputs)
            if "rotation_error_deg" in outputs:
                mosaic.facts["rotation_error_deg"] = outputs["rotation_error_deg"]
            progress(len(views) / count)
        return mosaic

    def consistency(self, image: InputImage, number: int, rng: Any) -> dict[str, float]:
        """Compare the predictions for a rotated panorama with that for the panorama itself.

        The views are rotated, so that nothing but the views is resampled. That is a rotation of
        the panorama by the inverse; all predictions have the orientation of the panorama.

        Args:
            image: The panorama.
            number: Number n of rotations of each of `TURNS`. Turns are by multiples of 360° / (n +
                1), rounded to whole columns of an equirectangular image, which are not resampled.
            rng: Source of the random rotations, a `numpy.random.Generator`.

        Returns:
            Means over the rotations of the scores of `Head.agreement`, by name of the column.
        """
        columns = max(self._views.image_size(image)[1], 2 * self._views.image_size(image)[0])
        angles = np.rint(np.arange(1, number + 1) * columns / (number + 1)) * 2 * np.pi / columns
        turns = [t for a in angles for t in (rotation_about((0, 0, 1), a), random_rotation(rng))]
        upright = np.eye(3) if image.up is None else upright_rotation(image.up)
        rotated = (replace(image, up=r[:, 2], rotation=r) for r in upright @ np.array(turns))
        images = (image, *rotated)
        first, *others = (PredictedImage.fetch(i, self.predict(i).pixels(), {}) for i in images)
        found = [self.head.agreement(first, other) for other in others]
        return {
            f"consistency_{name}_{turn}": float(np.mean([scores[name] for scores in found[k::2]]))
            for k, turn in enumerate(TURNS)
            for name in found[k]
        }


class UpLikelihood:
    """Estimates how likely directions are to be up, from the confidence of a network.

    A network that was trained on upright images is most confident on upright images. For each
    direction it gets four horizontal views of 135° that are upright for that direction; a network
    of whole spheres gets its own view. The uncertainty of a view is the mean of 1 − confidence over
    its pixels. The likelihood of a direction is the product of uncertainty⁻³ over up to 20 views.

    Args:
        loaded: The network.
        device: Device of the network.
    """

    def __init__(self, loaded: LoadedNetwork, device: torch.device | str = "cpu") -> None:
        self.loaded, self._device = loaded, device

    def __call__(self, image: Any, ups_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return log-likelihoods of directions, up to a common constant.

        Args:
            image: A panorama: an `InputImage`, or an `Image` of a data set.
            ups_xyz: ``(n, 3)`` directions in its frame.

        Returns:
            ``(n,)`` log-likelihoods. All are 0 for a network with elevation as an input, because
            that depends on the direction itself.
        """
        if "elevation" in self.loaded.inputs:
            return np.zeros(len(ups_xyz))
        rows = min(image.rgb.shape[0], 2 ** (self.loaded.level + 1))
        panorama = InputImage(image.rgb, image.depth)
        rendered = RenderedViews(self.loaded, panorama, (rows, 2 * rows), self._device)
        uncertainties = np.array([self._uncertainties(rendered, up) for up in ups_xyz])
        counted = min(uncertainties.shape[1], _COUNTED)
        return -_EXPONENT * counted * np.log(uncertainties + _LEAST).mean(axis=1)

    def _uncertainties(
        self, rendered: RenderedViews, up: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return the mean uncertainty of each view."""
        representation = self._representation
        per_forward = views_per_forward(representation.image_size)
        views = representation.with_rotation(upright_rotation(up)).view_sets()[0]
        if not self.loaded.is_spherical:
            views = views[:4]  # of a cube, without up and down
        sets = [(views, rendered.of(views), None)]
        found = [
            1 - scores.softmax(dim=1).amax(dim=1).nan_to_num(0).mean(dim=(1, 2))
            for _, scores, _ in scored_views(self._network, sets, per_forward)
        ]
        return torch.cat(found).cpu().numpy()

    @cached_property
    def _network(self) -> Any:
        """The network for pinhole images."""
        return make_ordinary(self.loaded.network)

    @cached_property
    def _representation(self) -> Any:
        """The views of an upright panorama."""
        loaded = self.loaded
        if loaded.is_spherical:
            return ViewSelector(loaded).representation
        quarter = round(2 / TangentGrid(0, loaded.level).pitch)  # pixels of 90° at its level
        least = quarter if loaded.fixed_size is None else max(loaded.fixed_size)
        side = -(-least // loaded.size_multiple) * loaded.size_multiple
        beyond = 1 - 1 / math.tan(math.radians(_FOV_DEG / 2))
        return CubemapRepresentation(loaded.level, side, margin=round(side / 2 * beyond))
