"""The Python API: load trained networks, map their classes, and apply them or any function.

A label map gives the classes of one data set as those of another. It is a JSON file with the names
of source classes for every target class::

    {"source": "ADE20K", "classes": {"wall": ["wall", "painting"], "floor": ["floor", "rug"]}}

The probability of a target class is the sum of the probabilities of its source classes.

Names are compared without case, and with hyphens and underscores as spaces. If a network names a
class by several synonyms ("windowpane, window"), only the first is compared; a map may list several
names (``"windowpane", "window"``). A network may lack some of the source classes. A target class
without source classes in the network is not predicted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal, NamedTuple, TypedDict, Unpack, overload

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from pydantic import PositiveInt
from torch import Tensor

from datamodules.core.depth import meters_to_steps
from datamodules.core.label_map import (
    DISTANCE,
    PIXEL_CLASSES,
    LabelMap,
    plain_name,
    read_label_map,
)
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.config.build import checks_types
from tangent_train.config.settings import Prompts, Threshold
from tangent_train.errors import SettingError, at_least, check_choice, check_type, width_height
from tangent_train.files import label_map_file
from tangent_train.geometry import PinholeGrid
from tangent_train.heads import head_of
from tangent_train.heads.alignment import AlignedMosaic
from tangent_train.heads.objects import described
from tangent_train.inference.engine import Predictor, UpLikelihood, views_per_forward
from tangent_train.inference.images import (
    InputImage,
    Picture,
    read_panorama,
    read_photo,
    with_up,
)
from tangent_train.inference.views import Levels, ViewChoice, ViewSelector
from tangent_train.io.gpano import Eye, Fill
from tangent_train.io.masks import Mask, Masks
from tangent_train.io.palette import class_colors
from tangent_train.kinds import Align, DepthKind, Upright
from tangent_train.rendering import Blend, equirect_to_tangent, tangent_to_equirect
from tangent_train.rendering.forward import check_grid, check_panorama
from tangent_train.rendering.mosaic import MeanMosaic, blend_back
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.resampling import Pixels, reduce_to_pitch

Unmapped = Literal["unknown", "never"]
"""Treatment of source classes that are not in a map: label 0 where they win, or they never win."""

Depth = Tensor | NDArray[Any] | None
"""``(H, W)`` floats in meters, 0 or NaN where missing."""

_Stored = str | Path | Image.Image | NDArray[Any]
"""Pictures whose results are arrays."""


class ImageSettings(TypedDict, total=False):
    """Arguments of the methods of `Network` besides the image, see `Network.labels`."""

    fov: float | None
    area: Sequence[float] | None
    upright: Upright
    mask: Mask | str | NDArray[Any] | Tensor
    eye: Eye | None


class LabelSettings(ImageSettings, total=False):
    """Arguments that only labels and probabilities need."""

    depth: Depth
    max_tilt_deg: float
    prompts: Prompts | None


@checks_types
def load(
    path: str | Path,
    *,
    prompts: Prompts | None = None,
    threshold: Threshold | None = None,
    label_map: str | Path | None = None,
    unmapped: Unmapped = "unknown",
    device: str | int | torch.device = "cpu",
    levels: Levels = None,
    base_level: int | None = None,
    blend: Blend = "feather",
    rotations: PositiveInt = 1,
    views: ViewChoice = None,
    fill: Fill | None = None,
    view_batch_size: PositiveInt | None = None,
    compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
    min_confidence: float = 0.0,
    align: Align | None = None,
    trust: str | Sequence[str] = (),
) -> Network:
    """Load a trained network from a file, for panoramas and photos.

    Settings and labels are the same as in ``tangent-predict``.

    Args:
        path: A checkpoint, or a file written by ``tangent-export`` or ``tangent-import``.
        prompts: Other texts that name the classes of CLIPSeg or SAM 3, e.g. ``["chair", "table"]``
            or ``{"seat": ["chair", "sofa"]}``, or a ``.txt`` file with a text per line.
        threshold: Probability that a class of prompts must exceed, else pixels are unknown; None as
            imported.
        label_map: Map to the classes of another data set: its name or a JSON file, see
            `load_label_map`.
        unmapped: Treatment of classes that are not in the map: ``unknown`` gives label 0 where they
            win; with ``never`` they cannot win.
        device: A torch device, or ``auto``: a GPU if there is one, else the CPU.
        levels: Level s, which sets the angular resolution, or several to average over; None as
            trained.
        base_level: Base level b of the tangent images; None as trained.
        blend: Blending of overlapping images.
        rotations: Number of rotations about the vertical to average over; 1 for photos.
        views: Views of panoramas: an option of ``representation=``, such as ``horizontal``; or with
            changed settings, ``{"option": "horizontal", "fov": 110}``. None as trained.
        fill: Colors outside the area of a partial panorama, in views that leave it: black, the mean
            color (``mean``), the nearest pixel (``edge``) or the mirrored image (``reflect``). None
            as trained.
        view_batch_size: Number of images per call of the network, which limits memory; None for
            as many as fit into 2^20 pixels.
        compile: Arguments of `torch.compile`, e.g. ``{"mode": "reduce-overhead"}`` for CUDA graphs;
            None to disable it.
        min_confidence: Pixels with a lower confidence get the label 0.
        align: Correction of the views of a depth network: ``none``, ``scale``, ``affine`` (a scale
            and a shift) or ``grid`` (also a coarse grid of scales). None for ``scale`` of networks
            that return meters, and ``affine`` of others.
        trust: Full names of classes from other packages that the file may instantiate.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting does not suit the network.
    """
    check_type("path", path, (str, Path), "the path of a network's file")
    of_file = load_network(Path(path), (trust,) if isinstance(trust, str) else trust)
    # A setting of another head is an unexpected argument.
    of_head = {"min_confidence": min_confidence, "align": align}
    of_head = {name: value for name, value in of_head.items() if value}
    chosen = levels, base_level, blend, rotations, views, fill

    def prepared(original: LoadedNetwork) -> tuple[LoadedNetwork, Predictor]:
        loaded = original
        if label_map is not None:
            loaded = map_classes(original, load_label_map(label_map), unmapped).loaded
        selector = ViewSelector(loaded, *chosen)
        of_device = device, view_batch_size, compile
        return loaded, Predictor(loaded, head_of(loaded, **of_head), selector, *of_device)

    return Network(of_file.prompted(prompts, threshold), prepared)


class Network:
    """A trained network for panoramas and photos, created by `load`.

    Images are files or in memory, see `Picture`. Files are read as in ``tangent-predict``, with
    their GPano tags. The EXIF orientation of files and Pillow images is applied. Results have the
    size of the image: tensors on the same device for tensors, else arrays.

    Args:
        original: The network, with its own classes.
        prepared: Returns the network with the classes of a label map, and its predictor.

    Attributes:
        loaded: The network, with its inputs, level and representation.
        class_names: K + 1 names of the labels, the unknown class first; none for depth networks.
        palette: ``(K + 1, 3)`` uint8 RGB colors of the labels; ``palette[labels]`` is an image.
    """

    def __init__(
        self,
        original: LoadedNetwork,
        prepared: Callable[[LoadedNetwork], tuple[LoadedNetwork, Predictor]],
    ) -> None:
        self._prepared = prepared
        self._prompts: Prompts | None = None
        self._use(original)

    def _use(self, original: LoadedNetwork) -> None:
        self._original = original
        self.loaded, self._predictor = self._prepared(original)
        self.class_names = self.loaded.class_names
        self.palette = class_colors(tuple(self.class_names))
        self._up_likelihood = UpLikelihood(original, self._predictor.device)

    @overload
    def labels(self, image: Tensor, **settings: Unpack[LabelSettings]) -> Tensor: ...
    @overload
    def labels(
        self, image: _Stored, **settings: Unpack[LabelSettings]
    ) -> NDArray[np.unsignedinteger]: ...
    def labels(
        self,
        image: Picture,
        *,
        depth: Depth = None,
        fov: float | None = None,
        area: Sequence[float] | None = None,
        upright: Upright = None,
        max_tilt_deg: float = 60.0,
        mask: Mask | str | NDArray[Any] | Tensor = None,
        eye: Eye | None = None,
        prompts: Prompts | None = None,
    ) -> NDArray[Any] | Tensor:
        """Return the label of every pixel.

        Args:
            image: A panorama, or a photo.
            depth: ``(H, W)`` floats in meters, 0 or NaN where missing, for networks with depth as
                an input, and for the distances of objects: distance from the center for panoramas,
                z-depth for photos.
            fov: Horizontal field of view of a photo in degrees; None for a panorama.
            area: West, east, south and north of a part of a panorama in degrees, see
                `read_area`. None to use the GPano tags of a file, or the whole sphere
                (W = 2 H) without tags.
            upright: Align a panorama with gravity: ``pose`` uses the GPano tags of a file; ``auto``
                uses them too, or an estimate from the image without tags.
            max_tilt_deg: Largest tilt that ``auto`` considers, in degrees.
            mask: Pixels of a panorama that get the label 0: below a latitude in degrees; black in
                a file; or 0 in an array or tensor. See `Masks`.
            eye: Eye of a stereo panorama, see `eye_part`; the labels are those of its picture.
            prompts: Texts that become the classes of CLIPSeg or SAM 3, see `load`; the network
                keeps them.

        Returns:
            ``(H, W)`` labels 1 … K, and 0 for unknown pixels: an array of uint8 (uint16 for many
            classes), or a tensor of int64.

        Raises:
            DataError: A file cannot be used, or the image is not a whole panorama.
            SettingError: The image cannot be used, or the network needs another input.
        """
        self.loaded.check_predicts(PIXEL_CLASSES, "Use depth() of this network.")
        given = self._read(image, depth, fov, area, upright, max_tilt_deg, eye, prompts)
        head: Any = self._predictor.head
        found = head.labels_in(self._predictor.predict(given).pixels().cpu().numpy())
        return _as_given(_masked(found, given, image, mask, 0), image)

    def panoptic(
        self, image: _Stored, **settings: Any
    ) -> tuple[NDArray[np.int32], list[dict[str, Any]]]:
        """Return the label and the object of every pixel, and a table of the objects.

        Args:
            image: A panorama, or a photo.
            **settings: Arguments of `labels`, except ``mask``.

        Returns:
            ``(H, W)`` panoptic map, see `metrics.panoptic`, in which the label is ``map // 65536``
            and the number of the object ``map % 65536``, 0 for none; and a table of the objects,
            see `heads.objects.described`.

        Raises:
            DataError: See `labels`.
            SettingError: See `labels`; or the network returns no objects.
        """
        if not self.loaded.things:
            expected = "a network of tangent-import with things="
            raise SettingError("network", found="one without objects", expected=expected)
        given = self._read(image, **settings)
        mosaic = self._predictor.predict(given)
        found = given.cut(mosaic.pixels().cpu().numpy())
        return found, described(mosaic.facts["objects"], self.loaded.class_names[1:], given)

    @overload
    def depth(self, image: Tensor, **settings: Unpack[ImageSettings]) -> Tensor: ...
    @overload
    def depth(self, image: _Stored, **settings: Unpack[ImageSettings]) -> NDArray[np.float32]: ...
    def depth(
        self,
        image: Picture,
        *,
        mask: Mask | str | NDArray[Any] | Tensor = None,
        **settings: Any,
    ) -> NDArray[Any] | Tensor:
        """Return the depth of every pixel: distance from the center, or z-depth in photos.

        Args:
            image: A panorama, or a photo.
            mask: Pixels of a panorama that get NaN, see `labels`.
            **settings: ``fov``, ``area``, ``upright`` and ``eye`` of `labels`. Of ``upright``, only
                ``pose`` suits a depth network.

        Returns:
            ``(H, W)`` float32, NaN where unknown: an array, or a tensor. In meters for networks
            that return meters. Others have an unknown unit: the median of the depth is 1, by solid
            angle (`loaded.depth_kind` starts with ``relative``).

        Raises:
            DataError: See `labels`.
            SettingError: See `labels`; or the views cannot be aligned in this way.
        """
        self.loaded.check_predicts(DISTANCE, "Use labels() or probabilities() of this network.")
        given = self._read(image, **settings)
        found = self._predictor.predict(given).pixels().cpu().numpy()
        return _as_given(_masked(found, given, image, mask, np.nan), image)

    @overload
    def probabilities(self, image: Tensor, **settings: Unpack[LabelSettings]) -> Tensor: ...
    @overload
    def probabilities(
        self, image: _Stored, **settings: Unpack[LabelSettings]
    ) -> NDArray[np.float32]: ...
    def probabilities(self, image: Picture, **settings: Any) -> NDArray[Any] | Tensor:
        """Return the probability of every class at every pixel.

        Args:
            image: A panorama, or a photo.
            **settings: Arguments of `labels`, except ``mask``.

        Returns:
            An array ``(H, W, K)`` or a tensor ``(K, H, W)`` of float32; index k belongs to label
            k + 1. Probabilities add up to 1, or to less for imported networks that also predict
            "none of the classes". All are 0 where the scores are NaN or infinite.

        Raises:
            DataError: See `labels`.
            SettingError: See `labels`.
        """
        self.loaded.check_predicts(PIXEL_CLASSES, "Use depth() of this network.")
        given = self._read(image, **settings)
        mosaic = self._predictor.predict(given, averaged=True)
        found = mosaic.probabilities(slice(None))[..., : len(self.class_names) - 1].cpu().numpy()
        return _as_given(np.ascontiguousarray(given.cut(found)), image)

    def _read(
        self,
        image: Picture,
        depth: Depth = None,
        fov: float | None = None,
        area: Sequence[float] | None = None,
        upright: Upright = None,
        max_tilt_deg: float = 60.0,
        eye: Eye | None = None,
        prompts: Prompts | None = None,
    ) -> InputImage:
        """Return a photo, or a panorama with its zenith; set the prompts."""
        if prompts not in (None, self._prompts):
            self._use(self._original.prompted(prompts))
            self._prompts = prompts
        is_given = depth is not None or "depth" in self.loaded.inputs
        of_size = partial(self._depth, depth) if is_given else None
        if fov is not None:
            return read_photo(image, fov, of_size)
        check_choice("upright", upright or "pose", ("pose", "auto"))
        check_type("max_tilt_deg", max_tilt_deg, Real, "degrees")
        check_choice("eye", eye or "left", ("left", "right"))
        panorama = read_panorama(image, area, upright, of_size, eye)
        if upright == "auto":
            panorama = with_up(panorama, max_tilt_deg, self._up_likelihood)
        return panorama

    def _depth(self, depth: Any, size: tuple[int, int]) -> NDArray[np.uint16]:
        """Return depth in steps of 1/512 m, of the size of the image."""
        array = depth.numpy(force=True) if isinstance(depth, Tensor) else np.asarray(depth)
        is_read = "depth" in self.loaded.inputs or self.loaded.things
        if not is_read or (array.shape, array.dtype.kind) != (size, "f"):
            raise SettingError(
                "depth",
                found="none" if depth is None else f"shape {array.shape} of {array.dtype}",
                expected=f"floats in meters, {width_height(size)}, for a network that takes depth "
                "or returns objects",
            )
        return meters_to_steps(np.nan_to_num(array.astype(np.float32), posinf=0).clip(min=0))


def _masked(
    result: NDArray[Any], given: InputImage, image: Any, mask: Any, unknown: float
) -> NDArray[Any]:
    """Return the result ``(H, W)`` for the area of a panorama, with masked pixels unknown."""
    if given.area is None:
        return result
    masks = Masks(mask.numpy(force=True) if isinstance(mask, Tensor) else mask)
    name = Path(image).stem if isinstance(image, str | Path) else ""
    is_shown = masks.read(name, given.area) > 0
    return given.cut(np.where(is_shown, result, result.dtype.type(unknown)))


def _as_given(result: NDArray[Any], image: Any) -> NDArray[Any] | Tensor:
    """Return a result ``(H, W[, K])``; for tensors, on their device and channels first."""
    if not isinstance(image, Tensor):
        return result
    tensor = torch.from_numpy(result.astype(np.int64) if result.dtype.kind == "u" else result)
    return (tensor if result.ndim == 2 else tensor.movedim(-1, 0).contiguous()).to(image.device)


@torch.no_grad()
def apply(
    function: Callable[[Pixels], Pixels],
    panorama: Pixels,
    grid: PinholeGrid,
    blend: Blend = "feather",
    *,
    images_per_call: int | None = None,
    align: Align | None = None,
    kind: DepthKind | None = None,
) -> Pixels:
    """Apply a function of images to a panorama: scores, depth, features, masks.

    The images are rendered a few at a time with `equirect_to_tangent`, and their results are
    rendered back as with `tangent_to_equirect`. Besides the result, only the images of one call are
    held in memory. There are no gradients.

    With `align`, the results are depth. They are converted to distances along the rays and brought
    to one scale: views are compared, and blended, in the logarithm of distance, or for disparity in
    disparity along the ray. The depth of all images is held in memory.

    Args:
        function: Maps some images of the panorama's kind and dtype to a result of as many pixels:
            arrays ``(n, h, w[, C])`` to ``(n, h, w[, K])``, or tensors ``(n, C, h, w)`` to
            ``(n, h, w)`` or ``(n, K, h, w)``. Called with all images of the grid, in its order.
        panorama: An array ``(H, W[, C])``, or a floating-point tensor ``(C, H, W)``.
        grid: The images.
        blend: Blending of results that are floats, as in `tangent_to_equirect`. Of whole numbers
            and booleans (labels, masks), each pixel is copied from its owner.
        images_per_call: Images per call of the function; None for as many as fit into 2^20 pixels.
        align: Correction of the depth of each image: ``scale``, ``affine`` (a scale and a shift),
            ``grid`` (also a coarse grid of scales) or ``none``. None for results that are not
            depth.
        kind: Kind of depth that the function returns, see `DepthKind`; only with `align`, which
            takes ``metric_z`` by default.

    Returns:
        An array ``(H, W[, K])``, or a tensor ``(H, W)`` or ``(K, H, W)`` on the panorama's device:
        float32 if the function returns floats, else the function's dtype. With `align`, distances
        ``(H, W)``, NaN where unknown: meters, or for relative kinds a median of 1, by solid angle.

    Raises:
        SettingError: The panorama cannot be used, or the function returns results of another kind
            or shape.

    >>> brightness = lambda images: images.mean(axis=-1)
    >>> from tangent_train.geometry import TangentGrid
    >>> apply(brightness, np.full((32, 64, 3), 0.5), TangentGrid(0, 4))[0, 0]
    np.float32(0.5)
    """
    check_type("function", function, Callable, "a function of images")  # type: ignore[arg-type]
    check_grid(grid)
    blend = blend_back(grid, blend)
    check_panorama(panorama, "bilinear")
    if images_per_call is not None:
        at_least("images_per_call", images_per_call, 1)
    step = images_per_call or views_per_forward(grid.size)
    rows, columns = panorama.shape[-2:] if isinstance(panorama, Tensor) else panorama.shape[:2]
    shape, views = (rows, columns), PinholeViews(grid)
    panorama = reduce_to_pitch(panorama, min(grid.pitches))
    kept: list[NDArray[Any]] = []
    mosaic: Any = None
    for faces in np.split(np.arange(grid.num_images), range(step, grid.num_images, step)):
        images = equirect_to_tangent(panorama, grid, faces)
        results = _as_array(function(images), images, is_depth=align is not None)
        if results.dtype.kind != "f":
            kept.append(results)
            continue
        flat = results.reshape(*results.shape[:3], -1).astype(np.float32)
        if mosaic is None and align is not None:
            mosaic = AlignedMosaic(shape, kind or "metric_z", blend, align)
        elif mosaic is None:
            mosaic = MeanMosaic(shape, blend, flat.shape[-1], skips_unknown=False)
        part = views[faces[0] : faces[-1] + 1]
        mosaic.add(torch.from_numpy(np.moveaxis(flat, -1, 1)), part)
    if align is not None:
        array = mosaic.distances().numpy()
    elif mosaic is not None:
        array = mosaic.values().movedim(0, -1).reshape(*shape, *results.shape[3:]).numpy()
    else:
        array = tangent_to_equirect(np.concatenate(kept), grid, shape, interpolation="nearest")
    if not isinstance(panorama, Tensor):
        return array
    result = torch.from_numpy(array)
    return (result if array.ndim == 2 else result.movedim(-1, 0)).to(panorama.device)


def _as_array(returned: Any, images: Tensor | NDArray[Any], *, is_depth: bool) -> NDArray[Any]:
    """Return the function's result for some images as an array ``(n, h, w[, K])``."""
    is_tensor, array = isinstance(images, Tensor), np.zeros(0)
    if is_tensor and isinstance(returned, Tensor):
        array = (returned.float() if returned.is_floating_point() else returned).numpy(force=True)
        array = np.moveaxis(array, 1, -1) if array.ndim == 4 else array
    elif not is_tensor and isinstance(returned, np.ndarray):
        array = returned
    size = images.shape[-2:] if is_tensor else images.shape[1:3]
    fits = array.ndim in (3, 4) and array.shape[:3] == (len(images), *size)
    is_one = array.dtype.kind == "f" and array.shape[3:] in ((), (1,))
    if fits and array.dtype.kind in "buif" and (is_one or not is_depth):
        return array
    raise SettingError(
        "result of the function",
        found=f"{type(returned).__name__} of shape {array.shape} and {array.dtype}",
        expected=f"{'depth' if is_depth else 'numbers'} for {len(images)} images of "
        f"{size[1]}×{size[0]} pixels, as {type(images).__name__}",
    )


class MappedNetwork(NamedTuple):
    """A network with the classes of a map.

    Attributes:
        loaded: The network.
        classes: Classes of the original network in each target class.
        description: Classes that were mapped, are missing and remain, in one line.
    """

    loaded: LoadedNetwork
    classes: Mapping[str, Sequence[str]]
    description: str


def load_label_map(given: str | Path) -> LabelMap:
    """Load a label map.

    Args:
        given: Name of a map of this package, such as ``ade20k_to_stanford2d3ds``, or the path of a
            file with the suffix ``.json``.

    Raises:
        SettingError: There is no map of this name.
        DataError: The file is missing or is not a valid label map.
    """
    check_type("label_map", given, (str, Path), "a name or a path")
    return read_label_map(label_map_file(given))


def map_classes(
    loaded: LoadedNetwork,
    label_map: LabelMap,
    unmapped: Unmapped = "unknown",
    targets: Sequence[str] | None = None,
) -> MappedNetwork:
    """Return a network with the classes of a map instead of its own.

    Args:
        loaded: The network.
        label_map: The map.
        unmapped: Treatment of classes that are not in the map. Unknown classes of an imported
            network remain unknown.
        targets: All target classes in order, without unknown; None for the classes of the map.

    Raises:
        SettingError: The map contains no class of the network, or a target that is not in
            `targets`; or unmapped classes of a network that returns labels shall never win.
    """
    loaded.check_predicts(PIXEL_CLASSES, "Leave label_map out.")
    targets = label_map.names if targets is None else targets
    target_of = {
        str(key): label_map.names[label - 1] for key, label in label_map.labels.items() if label
    }
    names = loaded.class_names[1:]
    mapped = [target_of.get(plain_name(name)) for name in names]
    rest = [name for name, target in zip(names, mapped, strict=True) if target is None]
    foreign = set(label_map.names) - set(targets)
    if foreign or len(rest) == len(names):
        raise SettingError(
            "label_map",
            found=f"target classes {', '.join(label_map.names)}",
            expected=f"a map from {', '.join(names)} to {', '.join(targets)}",
        )
    check_choice("unmapped", unmapped, ("unknown", "never"))
    if rest and loaded.score_kind == "labels":
        check_choice("unmapped", unmapped, ("unknown",))  # labels have no second best class
    groups = loaded.groups or [[k] for k in range(len(names))]

    def scores(target: str | None) -> tuple[int, ...]:
        chosen = [group for group, of in zip(groups, mapped, strict=False) if of == target]
        return tuple(k for group in chosen for k in group)

    unknown = tuple(k for group in groups[len(names) :] for k in group)
    unknown += scores(None) if unmapped == "unknown" else ()
    given = [*map(scores, targets), *([unknown] if unknown else [])]
    classes = {
        target: [name for name, of in zip(names, mapped, strict=True) if of == target]
        for target in targets
    }
    known = set(map(plain_name, names))
    described = {
        "not predicted": [target for target, of in classes.items() if not of],
        "not in the network": [name for name in target_of if name not in known],
        "unknown where they win" if unmapped == "unknown" else "never win": rest,
    }
    parts = [f"{target} ← {', '.join(of)}" for target, of in classes.items() if of]
    parts += [f"{text}: {', '.join(of)}" for text, of in described.items() if of]
    things = tuple(target for target, of in classes.items() if set(of) & set(loaded.things))
    names = ("unknown", *targets)
    changed = replace(loaded, class_names=names, groups=tuple(given), things=things)
    return MappedNetwork(changed, classes, shorten("; ".join(parts), 600, placeholder=" …"))
