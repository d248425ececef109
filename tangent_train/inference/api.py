"""Trained networks in Python: labels and depth of files, images in memory and tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.depth import meters_to_steps
from datamodules.core.image_module import Upright
from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from tangent_train.checkpoints.kinds import Align
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import SettingError, width_height
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import (
    InputImage,
    Picture,
    described,
    read_panorama,
    read_photo,
    with_up,
)
from tangent_train.inference.label_maps import Unmapped, load_label_map, map_classes
from tangent_train.inference.up_likelihood import UpLikelihood
from tangent_train.inference.views import Levels, PanoramaViews, PhotoViews, ViewChoice
from tangent_train.io.gpano import Fill
from tangent_train.io.masks import Mask, Masks
from tangent_train.io.palette import class_colors
from tangent_train.rendering import Blend
from tangent_train.rendering.checks import check_choice

Depth = Tensor | NDArray[Any] | None
"""``(H, W)`` floats in meters, 0 or NaN where missing."""

_SHOWN = 6


def load(
    path: str | Path,
    *,
    label_map: str | Path | None = None,
    unmapped: Unmapped = "unknown",
    device: str = "cpu",
    levels: Levels = None,
    base_level: int | None = None,
    blend: Blend = "feather",
    rotations: int = 1,
    views: ViewChoice = None,
    fill: Fill | None = None,
    view_batch_size: int | None = None,
    min_confidence: float = 0.0,
    align: Align | None = None,
    trust: str | Sequence[str] = (),
) -> Network:
    """Load a trained network from a file, for panoramas and photos.

    Settings and labels are the same as in ``tangent-predict``.

    Args:
        path: A checkpoint, or a file written by ``tangent-export`` or ``tangent-import``.
        label_map: Map to the classes of another data set: its name or a JSON file, see
            `label_maps.load_label_map`.
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
        min_confidence: Pixels with a lower confidence get the label 0.
        align: Correction of the views of a depth network: ``none``, ``scale``, ``affine`` (a scale
            and a shift) or ``grid`` (also a coarse grid of scales). None for ``scale`` of networks
            that return meters, and ``affine`` of others.
        trust: Full names of classes from other packages that the file may instantiate.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting does not suit the network.
    """
    original = load_network(Path(path), (trust,) if isinstance(trust, str) else trust)
    loaded = original
    if label_map is not None:
        loaded = map_classes(original, load_label_map(label_map), unmapped).loaded
    # A setting of another head is an unexpected argument.
    given = {"min_confidence": min_confidence, "align": align}
    head = head_of(loaded, **{name: value for name, value in given.items() if value})
    chosen, how = (loaded, levels, base_level, blend, rotations), (device, view_batch_size)
    panoramas = Predictor(loaded, head, PanoramaViews(*chosen, views, fill), *how)
    return Network(
        loaded,
        panoramas,
        lambda: Predictor(loaded, head, PhotoViews(*chosen), *how),
        UpLikelihood(original, panoramas.device),
    )


class Network:
    """A trained network for panoramas and photos, created by `load`.

    Images are files or in memory, see `Picture`. Files are read as in ``tangent-predict``, with
    their GPano tags. The EXIF orientation of files and Pillow images is applied. Results have the
    size of the image: tensors on the same device for tensors, else arrays.

    Args:
        loaded: The network.
        panoramas: Predictor for panoramas.
        photos: Function that creates the predictor for photos.
        up_likelihood: Evidence for the direction of up, from the network's confidence.

    Attributes:
        loaded: The network, with its inputs, level and representation.
        class_names: K + 1 names of the labels, the unknown class first; none for depth networks.
        palette: ``(K + 1, 3)`` uint8 RGB colors of the labels; ``palette[labels]`` is an image.
    """

    def __init__(
        self,
        loaded: LoadedNetwork,
        panoramas: Predictor,
        photos: Callable[[], Predictor],
        up_likelihood: UpLikelihood,
    ) -> None:
        self.loaded = loaded
        self.class_names = loaded.class_names
        self.palette = class_colors(len(loaded.class_names))
        self._panoramas = panoramas
        self._photos = cache(photos)
        self._up_likelihood = up_likelihood

    def __repr__(self) -> str:
        """Return classes or kind of depth, inputs, views and device in one line."""
        loaded, names = self.loaded, self.class_names[1:]
        shown = ", ".join(names[:_SHOWN]) + ", …" * (len(names) > _SHOWN)
        predicts = f"{len(names)} classes ({shown})" if names else f"depth ({loaded.depth_kind})"
        rows, columns = loaded.image_size
        kind = str(loaded.representation["_target_"]).rpartition(".")[2]
        return (
            f"<Network of {predicts}, inputs {', '.join(loaded.inputs)}, "
            f"trained at level {loaded.level} on {columns}×{rows} images of {kind}, "
            f"on {self._panoramas.device}>"
        )

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
    ) -> Any:
        """Return the label of every pixel.

        Args:
            image: A panorama, or a photo.
            depth: ``(H, W)`` floats in meters, 0 or NaN where missing, for networks with depth as
                an input: distance from the center for panoramas, z-depth for photos.
            fov: Horizontal field of view of a photo in degrees; None for a panorama.
            area: West, east, south and north of a part of a panorama in degrees, see
                `read_area`. None to use the GPano tags of a file, or the whole sphere
                (W = 2 H) without tags.
            upright: Align a panorama with gravity: ``pose`` uses the GPano tags of a file; ``auto``
                uses them too, or an estimate from the image without tags.
            max_tilt_deg: Largest tilt that ``auto`` considers, in degrees.
            mask: Pixels of a panorama that get the label 0: below a latitude in degrees; black in
                a file; or 0 in an array or tensor. See `Masks`.

        Returns:
            ``(H, W)`` labels 1 … K, and 0 for unknown pixels: an array of uint8 (uint16 for many
            classes), or a tensor of int64.

        Raises:
            DataError: A file cannot be used, or the image is not a whole panorama.
            SettingError: The image cannot be used, or the network needs another input.
        """
        self.loaded.check_predicts(PIXEL_CLASSES, "Use depth() of this network.")
        how: dict[str, Any] = {"depth": depth, "fov": fov, "area": area, "upright": upright}
        mosaic, read = self._predict(image, max_tilt_deg=max_tilt_deg, **how)
        labels = _cut(mosaic.pixels().cpu().numpy(), image, read, mask, 0)
        if isinstance(image, Tensor):
            return torch.from_numpy(labels.astype(np.int64)).to(image.device)
        return labels

    def depth(
        self,
        image: Picture,
        *,
        fov: float | None = None,
        area: Sequence[float] | None = None,
        upright: Upright = None,
        mask: Mask | str | NDArray[Any] | Tensor = None,
    ) -> Any:
        """Return the depth of every pixel: distance from the center, or z-depth in photos.

        Args:
            image: A panorama, or a photo.
            fov: See `labels`.
            area: See `labels`.
            upright: ``pose`` aligns a panorama with gravity by the GPano tags of its file.
            mask: Pixels of a panorama that get NaN, see `labels`.

        Returns:
            ``(H, W)`` float32, NaN where unknown: an array, or a tensor. In meters for networks
            that return meters. Others have an unknown unit: the median of the depth is 1, by solid
            angle (`loaded.depth_kind` starts with ``relative``).

        Raises:
            DataError: See `labels`.
            SettingError: See `labels`; or the views cannot be aligned in this way.
        """
        self.loaded.check_predicts(DISTANCE, "Use labels() or probabilities() of this network.")
        if upright == "auto":
            raise SettingError(
                "upright",
                found="auto",
                expected="pose or None for depth networks: auto needs the confidence of classes",
                remedy="Use pose for files with GPano tags, or a network of classes to align it.",
            )
        found, read = self._predict(image, fov=fov, area=area, upright=upright)
        depth = _cut(found.pixels().cpu().numpy(), image, read, mask, np.nan)
        return torch.from_numpy(depth).to(image.device) if isinstance(image, Tensor) else depth

    def probabilities(self, image: Picture, **settings: Any) -> Any:
        """Return the probability of every class at every pixel.

        Args:
            image: A panorama, or a photo.
            **settings: Arguments of `labels`, except ``mask``.

        Returns:
            An array ``(H, W, K)`` or a tensor ``(K, H, W)`` of float32; index k belongs to label
            k + 1. Probabilities add up to 1, or to less for imported networks that also predict
            "none of the classes".

        Raises:
            DataError: See `labels`.
            SettingError: See `labels`.
        """
        self.loaded.check_predicts(PIXEL_CLASSES, "Use depth() of this network.")
        mosaic, read = self._predict(image, averaged=True, **settings)
        found = mosaic.probabilities(slice(None))[..., : len(self.class_names) - 1].cpu().numpy()
        found = np.ascontiguousarray(read.cut(found))
        if isinstance(image, Tensor):
            return torch.from_numpy(found).movedim(-1, 0).contiguous().to(image.device)
        return found

    def _predict(
        self,
        image: Any,
        *,
        depth: Any = None,
        fov: float | None = None,
        area: Sequence[float] | None = None,
        upright: Upright = None,
        max_tilt_deg: float = 60.0,
        averaged: bool = False,
    ) -> tuple[Any, InputImage]:
        """Predict a photo or a panorama; return the mosaic and the image."""
        of_size = partial(self._depth, depth)
        if fov is not None:
            if (area, upright) != (None, None):
                raise SettingError("area and upright", found="one", expected="None for photos")
            photo = read_photo(image, fov, of_size)
            return self._photos().predict(photo, averaged=averaged), photo
        check_choice("upright", upright or "pose", ("pose", "auto"))
        panorama = read_panorama(image, area, upright, of_size)
        if upright == "auto":
            panorama = with_up(panorama, max_tilt_deg, self._up_likelihood)
        return self._panoramas.predict(panorama, averaged=averaged), panorama

    def _depth(self, depth: Any, size: tuple[int, int]) -> NDArray[np.uint16] | None:
        """Return depth in steps of 1/512 m, of the size of the image."""
        if depth is None and "depth" not in self.loaded.inputs:
            return None
        array = depth.numpy(force=True) if isinstance(depth, Tensor) else depth
        fits = isinstance(array, np.ndarray) and (array.shape, array.dtype.kind) == (size, "f")
        if not fits or "depth" not in self.loaded.inputs:
            raise SettingError(
                "depth",
                found="none" if depth is None else described(depth),
                expected=f"floats in meters, {width_height(size)}, for a network that takes depth",
            )
        return meters_to_steps(np.nan_to_num(array.astype(np.float32), posinf=0).clip(min=0))


def _cut(
    result: NDArray[Any], image: Any, read: InputImage, mask: Any, unknown: float
) -> NDArray[Any]:
    """Return the result ``(H, W)`` for the area of a panorama, with masked pixels unknown."""
    if read.area is None:
        return result
    masks = Masks(mask.numpy(force=True) if isinstance(mask, Tensor) else mask)
    name = Path(image).stem if isinstance(image, str | Path) else ""
    is_shown = masks.read(name, read.area) > 0
    return read.area.cut(np.where(is_shown, result, result.dtype.type(unknown)))
