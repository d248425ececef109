"""Labels of panoramas."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from datamodules.core.panoramas import resize_area, resize_depth
from tangent_train.errors import SettingError
from tangent_train.geometry import nearest_level
from tangent_train.inference.predictor import Done, InputImage, Level, Prediction, Runner
from tangent_train.inference.seen import panorama_representation
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.pinhole import PinholeRepresentation, spun, turns
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.upright.gravity import upright_rotation

if TYPE_CHECKING:
    from torch import Tensor

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.rendering import Blend, EquirectRepresentation

__all__ = ["PanoramaPredictor"]


class PanoramaPredictor:
    """Labels panoramas.

    Args:
        trained: The network.
        runner: Shows it images.
        level: Level s the network sees.
        base_level: Base level b of the tangent images; None as trained.
        blend: How overlapping images are joined; those that do not overlap are ``nearest``.
        rotations: Average over as many turned icosahedra, see `turns`.
        upright: Whether some panoramas will say that up is elsewhere than z.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        runner: Runner,
        level: Level = None,
        base_level: int | None = None,
        blend: Blend = "feather",
        rotations: int = 1,
        *,
        upright: bool = False,
    ) -> None:
        self._runner = runner
        self._turns = turns(rotations, "rotations")
        self._upright = upright
        self._blend = blend
        self._level = trained.level if level is None else level
        self._seen = lru_cache(maxsize=4)(
            partial(panorama_representation, trained, base_level=base_level)
        )
        if self._level != "image":
            self._check_turns(self._seen(self._level))

    def predict(self, image: InputImage, done: Done, *, averaged: bool = False) -> Prediction:
        """The scores of one panorama ``(H, W)`` of any size, twice as wide as high.

        Args:
            image: The whole sphere.
            done: Told of the progress.
            averaged: Whether probabilities will be asked for.

        Raises:
            SettingError: The network cannot be shown a panorama of this level.
        """
        height, width = image.rgb.shape[:2]
        level = nearest_level(height) if self._level == "image" else self._level
        seen = self._seen(level)
        small = _shrunk(image, (seen.erp_height, 2 * seen.erp_height))
        averaged = averaged or len(self._turns) > 1
        if isinstance(seen, PinholeRepresentation):
            if image.up is not None:
                seen = seen.turned(upright_rotation(image.up))
            blend = self._blend if seen.grid.overlapping else "nearest"
            mosaic = ScoreMosaic(
                (height, width), self._runner.num_classes, blend, averaged=averaged
            )
            self._add_images(mosaic, seen, small, done)
            views = seen.grid.num_images * len(self._turns)
            return Prediction(mosaic, level, views, seen.grid)
        self._check_turns(seen)
        mosaic = ScoreMosaic(
            (height, width), self._runner.num_classes, "nearest", averaged=averaged
        )
        self._add_whole(mosaic, seen, small)
        done(1.0)
        return Prediction(mosaic, level, 1)

    def _add_images(
        self, mosaic: ScoreMosaic, seen: PinholeRepresentation, image: InputImage, done: Done
    ) -> None:
        count = seen.grid.num_images
        for turn in self._turns:
            grid = spun(seen.grid, turn)
            parts = self._runner.parts(count, seen.image_size)
            views = [PinholeViews(grid, faces) for faces in parts]
            contexts = self._runner.contexts(image, views)
            for faces, part, context in zip(parts, views, contexts, strict=True):
                mosaic.add(self._runner.scores(image, part, context), grid, faces)
                done(len(faces) / count / len(self._turns))

    def _add_whole(
        self, mosaic: ScoreMosaic, seen: EquirectRepresentation, image: InputImage
    ) -> None:
        shape = seen.image_size
        scores = self._runner.scores(_enlarged(image, shape), seen.whole())
        # One crop that reaches over the seam and the poles by a pixel.
        (height, width), (rows, columns) = mosaic.shape, shape
        across, down = width / columns, height / rows
        box = np.array([[-across, -down, width + across, height + down]])
        crop = PhotoCrops(box, (rows + 2, columns + 2))
        mosaic.add_crops(_wrapped(scores), crop, np.array([0]))

    def _check_turns(self, seen: PinholeRepresentation | EquirectRepresentation) -> None:
        if isinstance(seen, PinholeRepresentation):
            return
        for name, found, expected in (
            ("rotations", len(self._turns), 1),
            ("upright", self._upright, False),
        ):
            if found != expected:
                raise SettingError(
                    name,
                    found=found,
                    expected=f"{expected or 'null'} for a network that sees equirectangular images",
                    remedy="Give base_level= to show it tangent images.",
                )


def _shrunk(image: InputImage, shape: tuple[int, int]) -> InputImage:
    """As training brings panoramas to the size it reads; smaller ones stay as they are."""
    if image.rgb.shape[0] <= shape[0]:
        return image
    depth = None if image.depth is None else resize_depth(image.depth, shape)
    return replace(image, rgb=resize_area(image.rgb, shape), depth=depth)


def _enlarged(image: InputImage, shape: tuple[int, int]) -> InputImage:
    """Of exactly this shape, interpolated across the seam; depth to the nearest pixel."""
    if image.rgb.shape[:2] == shape:
        return image
    height, width = shape
    half = image.rgb.shape[1] // 2
    around = np.concatenate([image.rgb[:, half:], image.rgb, image.rgb[:, :half]], axis=1)
    rgb = cv2.resize(around, (2 * width, height))[:, width // 2 : width // 2 + width]
    depth = None
    if image.depth is not None:
        depth = cv2.resize(image.depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return replace(image, rgb=np.ascontiguousarray(rgb), depth=depth)


def _wrapped(scores: Tensor) -> Tensor:
    """With one more pixel all around: across the seam, and half a turn on beyond the poles."""
    half = scores.shape[-1] // 2
    poles = [scores[..., row : row + 1 or None, :].roll(half, dims=-1) for row in (0, -1)]
    tall = torch.cat([poles[0], scores, poles[1]], dim=-2)
    return torch.cat([tall[..., -1:], tall, tall[..., :1]], dim=-1)
