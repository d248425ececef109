"""Trained networks in Python: labels of arrays and tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.panoramas import meters_to_steps
from datamodules.images.palette import class_colors
from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.errors import SettingError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.class_maps import Unmapped, load_class_map, map_classes
from tangent_train.inference.predictor import Predictor
from tangent_train.inference.views import InputImage, PanoramaViews, PhotoViews
from tangent_train.rendering import Blend
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.forward import Pixels
from tangent_train.rendering.mosaic import ScoreMosaic

Depth = Tensor | NDArray[Any] | None
"""``(H, W)`` floats: metres, 0 or NaN where missing."""


def load(
    path: str | Path,
    *,
    class_map: str | Path | None = None,
    unmapped: Unmapped = "unknown",
    device: str = "cpu",
    level: int | None = None,
    levels: Sequence[int] | None = None,
    base_level: int | None = None,
    blend: Blend = "feather",
    rotations: int = 1,
    images_per_forward: int | None = None,
    min_confidence: float = 0.0,
    trust: str | Sequence[str] = (),
) -> Network:
    """A trained network from a file, for panoramas and photos in memory.

    The settings are those of ``tangent-predict``, and so are the labels.

    Args:
        path: A checkpoint, or what ``tangent-export`` or ``tangent-import`` wrote.
        class_map: Labels of another data set: the name of a map, or a JSON file, see
            `class_maps.load_class_map`.
        unmapped: Classes that the map does not name are ``unknown``, label 0, where they win; or
            they ``never`` win.
        device: A torch device, or ``auto``: a GPU if there is one.
        level: Level s, the angular resolution; None as trained.
        levels: Several to average over, instead; of panoramas.
        base_level: Base level b of the tangent images; None as trained.
        blend: Blending of overlapping images.
        rotations: Number of icosahedra, rotated about the vertical, to average over.
        images_per_forward: Images per call of the network, which bounds memory; None for 2^20
            pixels' worth.
        min_confidence: Pixels whose best class has a lower probability get the label 0.
        trust: Full names of classes of other packages that the file may name.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting does not suit the network.
    """
    check_choice("unmapped", unmapped, get_args(Unmapped))
    trained = load_trained(Path(path), (trust,) if isinstance(trust, str) else trust)
    if class_map is not None:
        trained = map_classes(trained, load_class_map(class_map), unmapped).trained
    views = PanoramaViews(trained, levels or (level,), base_level, blend, rotations)
    how = device, images_per_forward, min_confidence
    return Network(
        trained,
        Predictor(trained, views, *how),
        lambda: Predictor(trained, PhotoViews(trained, level, base_level, blend), *how),
    )


class Network:
    """A trained network for panoramas and photos in memory; made by `load`.

    Images are RGB of 0 to 255: arrays ``(H, W, 3)`` or tensors ``(3, H, W)`` on any device, uint8.
    Panoramas show the whole sphere, W = 2 H, of any size. What is returned has the size of the
    image: arrays for arrays, tensors on the image's device for tensors.

    Args:
        trained: The network.
        panoramas: Its predictor of panoramas.
        photos: Makes its predictor of photos.

    Attributes:
        trained: The network, with its inputs, level and representation.
        class_names: K + 1 names of the labels, the unknown class first.
        palette: ``(K + 1, 3)`` uint8 RGB colours of the labels; ``palette[labels]`` is a picture.
    """

    def __init__(
        self, trained: TrainedNetwork, panoramas: Predictor, photos: Callable[[], Predictor]
    ) -> None:
        self.trained = trained
        self.class_names = trained.class_names
        self.palette = class_colors(len(trained.class_names))
        self._panoramas = panoramas
        self._make_photos = photos

    def labels(
        self,
        image: Pixels,
        *,
        depth: Depth = None,
        fov: float | None = None,
    ) -> Pixels:
        """Label of every pixel.

        Args:
            image: A panorama, or a photo.
            depth: ``(H, W)`` floats in metres, for networks that see depth, 0 or NaN where missing:
                the distance from the centre, in photos along the optical axis.
            fov: Horizontal field of view of a photo in degrees; None for a panorama.

        Returns:
            ``(H, W)`` labels 1 … K, and 0 where the network sees nothing it knows: an array of
            uint8, or uint16 of many classes, or a tensor of int64.

        Raises:
            SettingError: The image cannot be used, or the network needs another input.
        """
        mosaic = self._predict(image, depth, fov, probabilities=False)
        labels: Any = self.trained.labels(mosaic.labels())
        if isinstance(image, Tensor):
            return torch.from_numpy(labels.astype(np.int64)).to(image.device)
        return labels

    def scores(
        self,
        image: Pixels,
        *,
        depth: Depth = None,
        fov: float | None = None,
    ) -> Pixels:
        """Probability of every class at every pixel.

        Args:
            image: See `labels`.
            depth: See `labels`.
            fov: See `labels`.

        Returns:
            An array ``(H, W, K)`` or a tensor ``(K, H, W)`` of float32; number k is that of label
            k + 1. They add up to 1, or less by the share of what an imported network knows as none
            of the classes.

        Raises:
            SettingError: See `labels`.
        """
        mosaic = self._predict(image, depth, fov, probabilities=True)
        scores: Any = mosaic.probabilities(slice(None))[..., : len(self.class_names) - 1]
        scores = np.ascontiguousarray(scores)
        if isinstance(image, Tensor):
            return torch.from_numpy(scores).movedim(-1, 0).to(image.device)
        return scores

    def _predict(
        self, image: Any, depth: Any, fov: float | None, *, probabilities: bool
    ) -> ScoreMosaic:
        rgb = _rgb(image)
        size = (rgb.shape[0], rgb.shape[1])
        steps = self._depth(depth, size)
        if fov is not None:
            photo = InputImage(rgb, steps, camera_matrix=camera_matrix_from_fov(fov, size))
            return self._photos.predict(photo, probabilities=probabilities)
        if size[1] != 2 * size[0]:
            raise SettingError(
                "panorama",
                found="{}×{} pixels".format(*size),
                expected="the whole sphere, twice as wide as high",
                remedy="Of a photo, give fov=, its horizontal field of view in degrees.",
            )
        return self._panoramas.predict(InputImage(rgb, steps), probabilities=probabilities)

    @cached_property
    def _photos(self) -> Predictor:
        return self._make_photos()

    def _depth(self, depth: Any, size: tuple[int, int]) -> NDArray[np.uint16] | None:
        """Depth in steps of 1/512 m, of the size of the image."""
        wanted = "depth" in self.trained.inputs
        if depth is None and not wanted:
            return None
        array = depth.detach().cpu().numpy() if isinstance(depth, Tensor) else depth
        fits = isinstance(array, np.ndarray) and (array.shape, array.dtype.kind) == (size, "f")
        if not (wanted and fits):
            raise SettingError(
                "depth",
                found=_described(depth),
                expected="{}×{} floats, in metres".format(*size)
                if wanted
                else f"None: the network sees {' and '.join(self.trained.inputs)}",
            )
        return meters_to_steps(np.nan_to_num(array.astype(np.float32), posinf=0).clip(min=0))


def _rgb(image: Any) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)``."""
    is_tensor = isinstance(image, Tensor)
    array = image.detach().cpu().numpy() if is_tensor else image
    fits = isinstance(array, np.ndarray) and array.ndim == 3 and array.dtype == np.uint8
    channels = 0 if is_tensor else -1
    if fits and array.shape[channels] == 3 and array.size:
        return np.ascontiguousarray(np.moveaxis(array, channels, -1))
    raise SettingError(
        "image",
        found=_described(image),
        expected="RGB of 0 to 255: a uint8 tensor (3, H, W) or array (H, W, 3)",
    )


def _described(value: Any) -> str:
    if value is None:
        return "none"
    kind = type(value).__name__
    return f"{kind} {tuple(value.shape)} of {value.dtype}" if hasattr(value, "dtype") else kind
