"""Transforms of panoramas after reading: placing, mask, rotation, alignment with gravity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datamodules.core.loading import sample_rng
from datamodules.core.panoramas import ImageFiles, Panorama, resize_area
from tangent_train.geometry import random_rotation, rotation_about
from tangent_train.geometry.equirect import check_area
from tangent_train.io.gpano import Fill, PanoramaArea, area_of_angles, black_outside, read_up
from tangent_train.io.masks import Masks
from tangent_train.orientation.gravity import estimate_up
from tangent_train.orientation.manhattan import MOST_ROWS
from tangent_train.rendering import rotate_equirect

PanoramaJudge = Callable[[Panorama, "NDArray[np.float64]"], "NDArray[np.float64]"]
"""Returns log-likelihoods ``(n,)`` that directions ``(n, 3)`` of a panorama are up."""


def placed(
    canvas: PanoramaArea, fill: Fill, panorama: Panorama, index: int, files: ImageFiles
) -> Panorama:
    """Place a partial panorama on the whole sphere; a `Transform`.

    Args:
        canvas: Its area, in pixels of the whole panorama.
        fill: Colors outside.
        panorama: Panorama of the area's shape.
        index: Ignored.
        files: Ignored.
    """
    del index, files
    rgb, depth, labels, *_ = panorama
    return Panorama(
        canvas.filled(canvas.place(rgb), fill),
        None if depth is None else canvas.place(depth),
        canvas.place(labels),
        valid=canvas.valid,
    )


def masked(
    masks: Masks, canvas: PanoramaArea, panorama: Panorama, index: int, files: ImageFiles
) -> Panorama:
    """Make the labels of masked pixels unknown; a `Transform`.

    Args:
        masks: Masks of the panoramas.
        canvas: The area of the panoramas.
        panorama: Panorama; colors and depth stay unchanged.
        index: Ignored.
        files: Files of the panorama.
    """
    del index
    labels, counts = panorama.labels, masks.read(files.name, canvas)
    return panorama._replace(labels=np.where(counts, labels, labels.dtype.type(0)))


class PosedUp:
    """Sets the up direction of panoramas from their GPano tags; None without tags."""

    def __init__(self) -> None:
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def __call__(self, panorama: Panorama, index: int, files: ImageFiles) -> Panorama:
        """Return the panorama with `up`."""
        if index not in self._ups:
            self._ups[index] = read_up(files.rgb)
        return panorama._replace(up=self._ups[index])


class EstimatedUp:
    """Sets the up direction of panoramas, estimated where it is unknown.

    Views are aligned with gravity; pixels and labels stay in place. If the panorama has fewer rows
    than the estimate needs, its file is read again.

    Args:
        max_tilt_deg: Maximum tilt, see `estimate_up`.
        rgb: Function that reads the colors of a file.
        rotated: Rotation of the panoramas, if any.
        judge: Function that returns log-likelihoods of up directions, see `estimate_up`; it is not
            passed to other processes.
        area: The part of the sphere that the files show, see `check_area`; None for all of it.
    """

    def __init__(
        self,
        max_tilt_deg: float,
        rgb: Callable[[ImageFiles], NDArray[np.uint8]],
        rotated: RotatedPanoramas | None = None,
        judge: PanoramaJudge | None = None,
        area: Sequence[float] | None = None,
    ) -> None:
        self._max_tilt_deg = max_tilt_deg
        self._rgb = rgb
        self._area = area
        self._rotated = rotated
        self._judge = judge
        self._ups: dict[int, NDArray[np.float64] | None] = {}

    def __call__(self, panorama: Panorama, index: int, files: ImageFiles) -> Panorama:
        """Return the panorama with `up`; None if it cannot be estimated."""
        if panorama.up is not None:
            return panorama
        if index not in self._ups:
            rgb = black_outside(panorama.rgb, panorama.valid)  # estimates ignore what is black
            judge = self._judge and partial(self._judge, panorama._replace(rgb=rgb))
            rgb = rgb if len(rgb) >= MOST_ROWS else self._larger(index, files)
            self._ups[index] = estimate_up(rgb, self._max_tilt_deg, judge)
        return panorama._replace(up=self._ups[index])

    def _larger(self, index: int, files: ImageFiles) -> NDArray[np.uint8]:
        rgb = self._rgb(files)
        placed = area_of_angles((rgb.shape[0], rgb.shape[1]), check_area(self._area))
        canvas = PanoramaArea.on_canvas(self._area, min(placed.full_shape[0], MOST_ROWS))
        rgb = canvas.place(resize_area(rgb, canvas.image_shape))
        if self._rotated is None:
            return rgb
        return rotate_equirect(rgb, self._rotated.rotation(index), "bilinear")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_judge": None}


class RotatedPanoramas:
    """Rotates panoramas, as seen by a tilted camera.

    Labels rotate with the image, so scores are those of the rotated panorama. With the same seed,
    a panorama is rotated equally in every run.

    Args:
        rotation: Tilt in degrees about a random horizontal axis, after a random rotation about the
            vertical; or `so3`, uniform over all rotations.
        seed: Seed of the rotations.
        known: True if the up direction is known, e.g. from a camera with a gravity sensor.
    """

    def __init__(self, rotation: float | Literal["so3"], seed: int, *, known: bool = False) -> None:
        self._rotation = rotation
        self._seed = seed
        self._known = known

    def rotation(self, index: int) -> NDArray[np.float64]:
        """Return the rotation R of one panorama, ``(3, 3)``: direction d moves to R d."""
        rng = sample_rng(self._seed, 0, index)
        if self._rotation == "so3":
            return random_rotation(rng)
        yaw, azimuth = rng.uniform(0, 2 * math.pi, 2)
        axis = (math.cos(azimuth), math.sin(azimuth), 0)
        tilt = rotation_about(axis, math.radians(self._rotation))
        return tilt @ rotation_about((0, 0, 1), yaw)

    def __call__(self, panorama: Panorama, index: int, files: Any = None) -> Panorama:
        """Return the rotated panorama: RGB bilinear, depth and labels nearest."""
        del files
        rgb, depth, labels, before, valid = panorama
        rotation = self.rotation(index)
        up = rotation[:, 2] if before is None else rotation @ before
        return Panorama(
            rotate_equirect(rgb, rotation, "bilinear"),
            None if depth is None else rotate_equirect(depth, rotation, "nearest"),
            rotate_equirect(labels, rotation, "nearest"),
            up if self._known else None,
            None if valid is None else _rotated_mask(valid, rotation),
        )


def _rotated_mask(valid: NDArray[np.bool_], rotation: NDArray[np.float64]) -> NDArray[np.bool_]:
    return rotate_equirect(valid.astype(np.uint8), rotation, "nearest") > 0
