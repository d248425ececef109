"""Base data module of labeled panoramas."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from torch.utils.data import DataLoader

from datamodules.core.data_module import data_set
from datamodules.core.image_module import ImageDataModule, check_representation
from datamodules.core.images import Image, ImageFiles
from datamodules.core.loading import sample_rng
from datamodules.core.splits import Split
from tangent_train.geometry import random_rotation, rotation_about
from tangent_train.geometry.equirect import check_area
from tangent_train.io.gpano import (
    Fill,
    PanoramaArea,
    black_outside,
    check_resolution,
    read_area,
    read_up,
)
from tangent_train.io.masks import Masks
from tangent_train.orientation.gravity import estimate_up
from tangent_train.orientation.manhattan import MOST_ROWS
from tangent_train.progress import show_progress
from tangent_train.rendering import TangentRepresentation, rotate_equirect
from tangent_train.rendering.resampling import resize

Upright = Literal["pose", "auto"] | None
"""Source of the up direction of a panorama."""

TestRotation = Annotated[float, Field(ge=0, le=180)] | Literal["so3"] | None
"""Rotation of test panoramas: a tilt in degrees, uniformly random (SO(3)), or null."""

PanoramaJudge = Callable[[Image, "NDArray[np.float64]"], "NDArray[np.float64]"]
"""Returns log-likelihoods ``(n,)`` that directions ``(n, 3)`` of a panorama are up."""


@data_set
class PanoramaDataModule(ImageDataModule):
    """Labeled panoramas of one data set, see `ImageDataModule`.

    Args:
        batch_size: Panoramas per training step and process. Evaluation takes one at a time.
        area: The part of the sphere that all files show: west, east, south and north in degrees,
            see `check_area`; None for the whole sphere.
        fill: Colors of the panorama outside the area, in views that leave it.
        mask: Pixels that are ignored in training and evaluation, before the panorama is rotated:
            their labels are unknown. See `Masks`.
        test_rotation: Rotate the test panoramas, as seen by a tilted camera: a tilt in degrees
            about a random horizontal axis, after a random rotation about the vertical; or `so3`,
            uniform over all rotations. Labels rotate with the image.
        upright: Align tilted panoramas with gravity. `pose`: as their files say (GPano) and, of
            test panoramas, as they were rotated. `auto`: as their files say, else as estimated from
            the image.
        max_tilt_deg: Largest tilt that `auto` considers, a few degrees above that of the data.

    Attributes:
        erp_height: Rows of the panoramas read.
        canvas: The area, in pixels of these panoramas.

    Raises:
        DataError: The mask cannot be used.
    """

    noun: ClassVar[str] = "panoramas"
    fact_settings: ClassVar[tuple[str, ...]] = ("size", "area", "mask", "test_rotation")

    area: Sequence[float] | None = None
    fill: Fill = "mean"
    mask: Any = None
    test_rotation: TestRotation = None
    upright: Upright = None
    max_tilt_deg: Annotated[float, Field(gt=0, le=180)] = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_representation(self, "erp_height", "tangent")
        self.erp_height: int = self.representation.erp_height
        self.canvas = PanoramaArea.on_canvas(self.area, self.erp_height, "data.area")
        self.representation.view_sets(self.canvas.valid)  # refuses views that miss a pixel
        self._judge: PanoramaJudge | None = None
        self._ups: dict[tuple[Split, int], NDArray[np.float64] | None] = {}
        self._masks = Masks(self.mask, "data.mask")
        if not self._masks.of_each:
            self._masks.read("", self.canvas)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_judge": None}  # a network

    @property
    def size(self) -> str:
        """Width and height of the panoramas whose pixels are scored."""
        return f"{2 * self.erp_height} × {self.erp_height}"

    @property
    def read_shape(self) -> tuple[int, int]:
        """Rows and columns of the area in panoramas of `erp_height` rows."""
        return self.canvas.image_shape

    def default_representation(self) -> TangentRepresentation:
        """Tangent images of base level 0, at level 7."""
        return TangentRepresentation(0, 7 if self.level is None else self.level)

    def check_files(self, files: ImageFiles) -> None:
        """See `ImageDataModule`; also checks that the panorama has a mask."""
        super().check_files(files)
        if self._masks.of_each:
            self._masks.check(files.name, self.canvas)

    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """See `ImageDataModule`: the panorama has enough pixels, in the shape of the area."""
        check_resolution(files.rgb, size, self.canvas, self.area)

    def finish(self, item: Image, split: Split, index: int) -> Image:
        """See `DataModule`: placed on the sphere, masked, rotated, then aligned with gravity."""
        files: ImageFiles = self.splits()[split][index]
        image = place(item, self.canvas, self.fill)
        if self.mask is not None:
            counts, labels = self._masks.read(files.name, self.canvas), image.labels
            image = image._replace(labels=np.where(counts, labels, labels.dtype.type(0)))
        rotation = None
        if self.upright is not None:
            image = image._replace(up=read_up(files.rgb))
        if split == "test" and self.test_rotation is not None:
            rotation = draw_rotation(self.test_rotation, self.seed, index)
            image = rotate(image, rotation, is_known=self.upright == "pose")
        if self.upright == "auto" and image.up is None:
            if (split, index) not in self._ups:
                self._ups[split, index] = self._estimated_up(image, files, rotation, split)
            image = image._replace(up=self._ups[split, index])
        return image

    def _estimated_up(
        self, image: Image, files: ImageFiles, rotation: NDArray[np.float64] | None, split: Split
    ) -> NDArray[np.float64] | None:
        """Estimate the up direction; small panoramas are read again at the size of the file."""
        rgb = black_outside(image.rgb, image.valid)  # estimates ignore what is black
        judge = self._judge if split == "test" else None
        evidence = judge and partial(judge, image._replace(rgb=rgb))
        if len(rgb) < MOST_ROWS:
            rgb = self.decode(files).rgb
            size = rgb.shape[0], rgb.shape[1]
            whole = read_area(files.rgb, size, check_area(self.area)).full_shape
            canvas = PanoramaArea.on_canvas(self.area, min(whole[0], MOST_ROWS))
            rgb = canvas.place(resize(rgb, canvas.image_shape, "bilinear"))
            rgb = rgb if rotation is None else rotate_equirect(rgb, rotation, "bilinear")
        return estimate_up(rgb, self.max_tilt_deg, evidence)

    def estimate_up(self, judge: PanoramaJudge) -> None:
        """Let a network help to estimate the up directions of the test panoramas.

        They are estimated when the loader of the test split is created, because the network is on
        its device by then. Without ``upright=auto`` nothing changes.

        Args:
            judge: Returns log-likelihoods of up directions, see `gravity.estimate_up`.
        """
        if self.upright == "auto":
            self._judge = judge
            self._ups = {key: up for key, up in self._ups.items() if key[0] != "test"}
            self._datasets.pop("test", None)

    def test_dataloader(self) -> DataLoader[Any]:
        """Return the test batches; a network first estimates the up directions, in this process."""
        dataset = self.dataset("test")
        if self._judge is not None:
            read = (dataset.read(index) for index in range(len(dataset)))
            show_progress(read, "Estimating up", self.noun, len(dataset))
        return super().test_dataloader()


def place(image: Image, canvas: PanoramaArea, fill: Fill) -> Image:
    """Place a partial panorama on the whole sphere.

    Args:
        image: Panorama of the area's shape.
        canvas: Its area, in pixels of the whole panorama.
        fill: Colors outside.
    """
    if canvas.is_whole:
        return image
    return image._replace(
        rgb=canvas.filled(canvas.place(image.rgb), fill),
        depth=None if image.depth is None else canvas.place(image.depth),
        labels=canvas.place(image.labels),
        valid=canvas.valid,
    )


def draw_rotation(rotation: float | Literal["so3"], seed: int, index: int) -> NDArray[np.float64]:
    """Draw the rotation R of a test panorama, ``(3, 3)``: direction d moves to R d.

    Args:
        rotation: See `PanoramaDataModule.test_rotation`.
        seed: Seed of the run.
        index: Index of the panorama.
    """
    rng = sample_rng(seed, 0, index)
    if rotation == "so3":
        return random_rotation(rng)
    yaw, azimuth = rng.uniform(0, 2 * math.pi, 2)
    tilt = rotation_about((math.cos(azimuth), math.sin(azimuth), 0), math.radians(rotation))
    return tilt @ rotation_about((0, 0, 1), yaw)


def rotate(image: Image, rotation: NDArray[np.float64], *, is_known: bool) -> Image:
    """Rotate a panorama: RGB bilinear, depth, labels and mask nearest.

    Args:
        image: The panorama.
        rotation: Rotation R, ``(3, 3)``.
        is_known: True if its up direction is then known, e.g. from a camera with a gravity sensor.
    """
    up = rotation[:, 2] if image.up is None else rotation @ image.up
    valid, depth = image.valid, image.depth
    if valid is not None:
        valid = rotate_equirect(valid.astype(np.uint8), rotation, "nearest") > 0
    return image._replace(
        rgb=rotate_equirect(image.rgb, rotation, "bilinear"),
        depth=None if depth is None else rotate_equirect(depth, rotation, "nearest"),
        labels=rotate_equirect(image.labels, rotation, "nearest"),
        up=up if is_known else None,
        valid=valid,
    )
