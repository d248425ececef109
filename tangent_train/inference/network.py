"""Trained networks in Python: label files, images in memory and tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.image_module import Upright
from datamodules.core.labels import PIXEL_CLASSES
from datamodules.core.panoramas import meters_to_steps
from datamodules.images.gpano import Fill, PanoramaArea
from datamodules.images.masks import Mask, Masks
from datamodules.images.palette import class_colors
from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.errors import SettingError, width_height
from tangent_train.inference.class_maps import Unmapped, load_class_map, map_classes
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import (
    Picture,
    described,
    read_panorama,
    read_photo,
    with_up,
)
from tangent_train.inference.judge import NetworkJudge
from tangent_train.inference.representations import Levels, PanoramaViews, PhotoViews, ViewChoice
from tangent_train.rendering import Blend
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.mosaic import ScoreMosaic

Depth = Tensor | NDArray[Any] | None
"""``(H, W)`` floats in meters, 0 or NaN where missing."""

_SHOWN = 6


def load(
    path: str | Path,
    *,
    class_map: str | Path | None = None,
    unmapped: Unmapped = "unknown",
    device: str = "cpu",
    levels: Levels = None,
    base_level: int | None = None,
    blend: Blend = "feather",
    rotations: int = 1,
    views: ViewChoice = None,
    fill: Fill | None = None,
    images_per_forward: int | None = None,
    min_confidence: float = 0.0,
    trust: str | Sequence[str] = (),
) -> Network:
    """Load a trained network from a file, for panoramas and photos.

    Settings and labels are the same as in ``tangent-predict``.

    Args:
        path: A checkpoint, or a file written by ``tangent-export`` or ``tangent-import``.
        class_map: Map to the classes of another data set: its name or a JSON file, see
            `class_maps.load_class_map`.
        unmapped: Treatment of classes that are not in the map: ``unknown`` gives label 0 where they
            win; with ``never`` they cannot win.
        device: A torch device, or ``auto``: a GPU if there is one, else the CPU.
        levels: Level s, which sets the angular resolution, or several to average over; None as
            trained.
        base_level: Base level b of the tangent images; None as trained.
        blend: Blending of overlapping images.
        rotations: Number of rotations about the vertical to average over; 1 for photos.
        views: Views of panoramas: an option of ``representation=``, such as ``ring``; or with
            changed settings, ``{"option": "ring", "fov": 110}``. None as trained.
        fill: Colors outside the area of a partial panorama, in views that leave it: black, the mean
            color (``mean``), the nearest pixel (``edge``) or the mirrored image (``reflect``). None
            as trained.
        images_per_forward: Number of images per call of the network, which limits memory; None for
            as many as fit into 2^20 pixels.
        min_confidence: Pixels with a lower confidence get the label 0.
        trust: Full names of classes from other packages that the file may instantiate.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting does not suit the network.
    """
    check_choice("unmapped", unmapped, get_args(Unmapped))
    check_choice("fill", "mean" if fill is None else fill, get_args(Fill))
    original = load_trained(Path(path), (trust,) if isinstance(trust, str) else trust)
    trained = original
    original.check_predicts(PIXEL_CLASSES)
    if class_map is not None:
        trained = map_classes(original, load_class_map(class_map), unmapped).trained
    chosen = trained, levels, base_level, blend, rotations
    how = device, images_per_forward, min_confidence
    panoramas = Predictor(trained, PanoramaViews(*chosen, views, fill), *how)
    return Network(
        trained,
        panoramas,
        lambda: Predictor(trained, PhotoViews(*chosen), *how),
        NetworkJudge(original, panoramas.device),
    )


class Network:
    """A trained network for panoramas and photos, created by `load`.

    Images are files or in memory, see `Picture`. Files are read as in ``tangent-predict``, with
    their GPano tags. The EXIF orientation of files and Pillow images is applied. Results have the
    size of the image: tensors on the same device for tensors, else arrays.

    Args:
        trained: The network.
        panoramas: Predictor for panoramas.
        photos: Function that creates the predictor for photos.
        judge: Evidence for the direction of up, from the network's confidence.

    Attributes:
        trained: The network, with its inputs, level and representation.
        class_names: K + 1 names of the labels, the unknown class first.
        palette: ``(K + 1, 3)`` uint8 RGB colors of the labels; ``palette[labels]`` is an image.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        panoramas: Predictor,
        photos: Callable[[], Predictor],
        judge: NetworkJudge,
    ) -> None:
        self.trained = trained
        self.class_names = trained.class_names
        self.palette = class_colors(len(trained.class_names))
        self._panoramas = panoramas
        self._photos = cache(photos)
        self._judge = judge

    def __repr__(self) -> str:
        """Return classes, inputs, views and device in one line."""
        trained, names = self.trained, self.class_names[1:]
        shown = ", ".join(names[:_SHOWN]) + ", …" * (len(names) > _SHOWN)
        rows, columns = trained.image_size
        kind = str(trained.representation["_target_"]).rpartition(".")[2]
        return (
            f"<Network of {len(names)} classes ({shown}), inputs {', '.join(trained.inputs)}, "
            f"trained at level {trained.level} on {columns}×{rows} images of {kind}, "
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
                `area_of_angles`. None to use the GPano tags of a file, or the whole sphere
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
        if mask is not None and fov is not None:
            raise SettingError("mask", found="one, with fov=", expected="None for photos")
        masks = Masks(mask.numpy(force=True) if isinstance(mask, Tensor) else mask)
        how: dict[str, Any] = {"depth": depth, "fov": fov, "area": area, "upright": upright}
        mosaic, shown = self._predict(image, max_tilt_deg=max_tilt_deg, **how)
        labels: Any = self.trained.labels(mosaic.labels())
        if shown is not None:
            name = Path(image).stem if isinstance(image, str | Path) else ""
            labels = shown.cut(np.where(masks.read(name, shown) > 0, labels, labels.dtype.type(0)))
        if isinstance(image, Tensor):
            return torch.from_numpy(labels.astype(np.int64)).to(image.device)
        return labels

    def scores(self, image: Picture, **settings: Any) -> Any:
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
        mosaic, shown = self._predict(image, probabilities=True, **settings)
        scores: Any = mosaic.probabilities(slice(None))[..., : len(self.class_names) - 1]
        if shown is not None:
            scores = torch.from_numpy(np.ascontiguousarray(shown.cut(scores.cpu().numpy())))
        if isinstance(image, Tensor):
            return scores.movedim(-1, 0).contiguous().to(image.device)
        return scores.contiguous().cpu().numpy()

    def _predict(
        self,
        image: Any,
        *,
        depth: Any = None,
        fov: float | None = None,
        area: Sequence[float] | None = None,
        upright: Any = None,
        max_tilt_deg: float = 60.0,
        probabilities: bool = False,
    ) -> tuple[ScoreMosaic, PanoramaArea | None]:
        """Predict a photo, or a panorama with the area of the sphere that it covers."""
        of_size = partial(self._depth, depth)
        if fov is not None:
            if area is not None or upright is not None:
                given = "area" if area is not None else "upright"
                raise SettingError(given, found="one, with fov=", expected="None for photos")
            photo = read_photo(image, fov, of_size)
            return self._photos().predict(photo, probabilities=probabilities), None
        if upright is not None:
            check_choice("upright", upright, ("pose", "auto"))
            if upright == "pose" and not isinstance(image, str | Path):
                raise SettingError(
                    "upright",
                    found=f"pose, of {described(image)}",
                    expected="auto or None: only files have GPano tags",
                    remedy="Give the path of the panorama.",
                )
        panorama, shown = read_panorama(image, area, upright, of_size)
        if upright == "auto":
            panorama = with_up(panorama, max_tilt_deg, self._judge)
        return self._panoramas.predict(panorama, probabilities=probabilities), shown

    def _depth(self, depth: Any, size: tuple[int, int]) -> NDArray[np.uint16] | None:
        """Return depth in steps of 1/512 m; refuse depth of another size or kind."""
        is_input = "depth" in self.trained.inputs
        if depth is None and not is_input:
            return None
        array = depth.numpy(force=True) if isinstance(depth, Tensor) else depth
        fits = isinstance(array, np.ndarray) and (array.shape, array.dtype.kind) == (size, "f")
        if not (is_input and fits):
            raise SettingError(
                "depth",
                found="none" if depth is None else described(depth),
                expected=f"floats in meters, {width_height(size)}"
                if is_input
                else f"None: the network's inputs are {' and '.join(self.trained.inputs)}",
            )
        return meters_to_steps(np.nan_to_num(array.astype(np.float32), posinf=0).clip(min=0))
