"""Images, and samples: the views that are rendered from them, by seed, epoch and index."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from datamodules.core.depth import STEPS_PER_M
from datamodules.core.files import Split
from datamodules.core.inputs import MAX_DEPTH_M, Input
from tangent_train.geometry import equirect_elevations, random_rotation, rotation_about
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering.representations.views import Views
from tangent_train.threads import in_threads

if TYPE_CHECKING:
    from tangent_train.rendering.representations.views import Sampler

Labels = NDArray[np.integer[Any]]
"""Labels ``(H, W)``, 0 where unknown: uint8 classes, uint16 distances in steps of 1/512 m, or an
int32 panoptic map."""

_Images = TypeVar("_Images", Sequence[Tensor], Tensor)

_HUE_SHARE = 0.1


class Image(NamedTuple):
    """One panorama or photo.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 distance from the center in steps of 1/512 m, 0 where missing; None
            if not read. Before `ImageDataModule.read`, z-depth of photos.
        labels: `Labels`; with distances, `depth` is None.
        up: ``(3,)`` direction of the zenith in a panorama, a unit vector; None if it is z.
        valid: ``(H, W)`` bool, the recorded pixels of a panorama; None if all are. Elsewhere,
            labels and depth are 0, and colors are filled.
        camera_matrix: ``(3, 3)`` K of a photo for integer pixel centers, without skew; None for a
            panorama.

    The arrays may be shared or read-only: not to be written to.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    labels: Labels
    up: NDArray[np.float64] | None = None
    valid: NDArray[np.bool_] | None = None
    camera_matrix: NDArray[np.float64] | None = None

    def sampler(self, representation: Any) -> Sampler:
        """Return the sampler of its views: of a panorama aligned with gravity, of a photo crops."""
        sampler: Sampler = representation
        if self.camera_matrix is not None:
            sampler = representation.of_camera(self.camera_matrix, self.labels.shape)
        elif self.up is not None:
            sampler = representation.with_rotation(upright_rotation(self.up))
        return sampler


class Sample(NamedTuple, Generic[_Images]):
    """P views of one panorama or photo; collating adds a leading batch dimension.

    In training they are random. In evaluation they are those of all view sets, one after the other,
    and the labels are those of the whole image.

    Attributes:
        images: As rendered, to save bytes: RGB ``(P, h, w, 3)`` uint8, optionally depth
            ``(P, h, w)`` int16 and elevation ``(P, h, w)`` float32. `normalize` converts them to
            ``(P, C, h, w)`` float32 on the device.
        labels: ``(P, h, w)`` uint8, or int32 for distances and panoptic maps; in evaluation of a
            panorama ``(H, W)``.
        ray_lengths: ``(1 or P, h, w)`` float32, see `Views.ray_lengths`, for distances as labels;
            else a 1, ``(1, 1, 1)``.
        index: Index in its split.
        rotation: ``(3, 3)`` float64 rotation of the representation that aligns it with gravity. In
            evaluation.
        valid: ``(H, W)`` bool, valid pixels of a partial panorama; ``(0, 0)`` if all are. In
            evaluation.
    """

    images: _Images
    labels: Tensor
    ray_lengths: Tensor
    index: int  # type: ignore[assignment]  # hides tuple.index
    rotation: Tensor = torch.eye(3, dtype=torch.float64)
    valid: Tensor = torch.empty(0, 0, dtype=torch.bool)


def valid_mask(valid: Tensor) -> NDArray[np.bool_] | None:
    """Return the mask of `Sample.valid`; None if all pixels are valid."""
    return valid.cpu().numpy() if valid.numel() else None


def sample_rng(seed: int | tuple[int, int], epoch: int, index: int) -> np.random.Generator:
    """Random generator of one sample.

    Args:
        seed: Seed of the run, or two of them; (seed, 0) is the same as the seed alone.
        epoch: Epoch, from 0.
        index: Index of the sample in its data set.
    """
    # A spawn key, not a longer seed: NumPy pads short seeds with zeros, so [1, 2] is [1, 2, 0].
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch, index)))


def draw_rotation(rotation: float | Literal["so3"], seed: int, index: int) -> NDArray[np.float64]:
    """Draw the rotation R of a test image or shape, ``(3, 3)``: direction d moves to R d.

    Args:
        rotation: `so3`, or the tilt in degrees after a random rotation about the vertical.
        seed: Seed of the run.
        index: Index in the test split.
    """
    rng = sample_rng(seed, 0, index)
    if rotation == "so3":
        return random_rotation(rng)
    yaw, azimuth = rng.uniform(0, 2 * math.pi, 2)
    tilt = rotation_about((math.cos(azimuth), math.sin(azimuth), 0), math.radians(rotation))
    return tilt @ rotation_about((0, 0, 1), yaw)


class SplitDataset(Dataset[Any]):
    """The images or shapes of one split, decoded; a subclass renders samples from them (`sample`).

    Attributes:
        data: The data module.
        split: Name of the split.
        files: Files of each image or shape.
    """

    def __init__(self, data: Any, split: Split) -> None:
        self.data, self.split = data, split
        self.files: Sequence[Any] = data.splits()[split]
        self._kept: list[Any] = []
        if data.in_memory:
            # Where loaders fork their workers, these share the memory.
            self._kept = list(in_threads(self._copied, range(len(self))))

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, key: int | tuple[int, int]) -> Any:
        """Return a sample by index, or epoch and index; an index alone means epoch 0."""
        epoch, index = key if isinstance(key, tuple) else (0, key)
        index = range(len(self))[index]  # also negative
        data = self.data
        return self.sample(index, sample_rng((data.seed, data.sampling_seed), epoch, index))

    @abstractmethod
    def sample(self, index: int, rng: np.random.Generator) -> Any:
        """Return a sample: random views for training, all views for validation and test."""

    def name(self, index: int) -> str:
        """Unique short name of an image or shape; ``/`` between groups."""
        name: str = self.files[index].name
        return name

    def read(self, index: int) -> Any:
        """Return one image or shape; its arrays may be shared or read-only.

        Raises:
            DataError: A file is broken.
        """
        if self._kept:
            return self._kept[index]
        return self.data.finish(self.data.read_cached(self.files[index]), self.split, index)

    def _copied(self, index: int) -> Any:
        image = self.read(index)
        # Arrays that are views of a file keep it open.
        return image._make(np.array(a) if isinstance(a, np.ndarray) else a for a in image)


class ImageDataset(SplitDataset):
    """Views of panoramas or photos."""

    def sample(self, index: int, rng: np.random.Generator) -> Sample[Sequence[Tensor]]:
        """See `SplitDataset`."""
        image, data = self.read(index), self.data
        sampler, is_training = image.sampler(data.representation), self.split == "train"
        view_sets = (
            [sampler.sample(rng, image.valid)] if is_training else sampler.view_sets(image.valid)
        )
        of_sets = [render_inputs(image, views, data.inputs) for views in view_sets]
        images = list(map(torch.cat, zip(*of_sets, strict=True)))
        lengths = torch.ones(1, 1, 1)
        if image.labels.dtype == np.uint16:
            lengths = torch.from_numpy(np.concatenate([v.ray_lengths() for v in view_sets]))
        if is_training:
            if data.color_jitter:
                images[0] = jitter_colors(images[0], data.color_jitter, rng)
            labels = view_sets[0].render(image.labels, "nearest")
            return Sample(images, _tensor(labels), lengths, index)
        labels = image.labels
        if image.camera_matrix is not None:  # of crops, in which every pixel counts once
            (crops,) = view_sets
            labels = np.where(crops.owned(), crops.render(labels, "nearest"), np.uint8(0))
        sample = Sample(images, _tensor(labels), lengths, index)
        if image.up is not None:
            sample = sample._replace(rotation=torch.from_numpy(upright_rotation(image.up)))
        return sample if image.valid is None else sample._replace(valid=torch.tensor(image.valid))

    def labels(self, index: int) -> NDArray[Any]:
        """Return the labels of the valid pixels of an image, without decoding colors."""
        data = self.data
        if self._kept or data.cache is not None or getattr(data, "mask", None) is not None:
            image = self.read(index)
            return image.labels if image.valid is None else image.labels[image.valid]
        labels: NDArray[Any] = data.read_labels(self.files[index])
        return labels


def _tensor(array: NDArray[Any]) -> Tensor:
    """Return an array as a tensor of its own: the array may be that of an image."""
    # torch has few operations on uint16.
    return torch.tensor(array.astype(np.int32) if array.dtype == np.uint16 else array)


def render_inputs(image: Any, views: Views, inputs: Sequence[Input]) -> tuple[Tensor, ...]:
    """Render the inputs of a network, before `normalize`.

    Args:
        image: A panorama or photo, with `depth` if depth is an input.
        views: Views of the image.
        inputs: See `Input`.

    Returns:
        RGB ``(n, h, w, 3)`` uint8; with depth, ``(n, h, w)`` int16 steps up to `MAX_DEPTH_M`; with
        elevation, ``(n, h, w)`` float32.
    """
    rendered = [views.render(image.rgb, "bilinear")]
    if "depth" in inputs and image.depth is not None:
        steps = np.minimum(views.render(image.depth, "nearest"), int(MAX_DEPTH_M * STEPS_PER_M))
        rendered.append(steps.view(np.int16))  # torch has few operations on uint16
    if "elevation" in inputs:
        shape, up = image.rgb.shape[:2], image.up
        elevations = _upright_elevations(shape) if up is None else equirect_elevations(shape, up)
        rendered.append(views.render(elevations, "bilinear"))
    # What is rendered may be the panorama itself, shared or a read-only file: copy it.
    return tuple(torch.from_numpy(a) if a.flags.owndata else torch.tensor(a) for a in rendered)


@lru_cache(maxsize=2)
def _upright_elevations(shape: tuple[int, int]) -> NDArray[np.float32]:
    elevations = equirect_elevations(shape)
    elevations.setflags(write=False)
    return elevations


def jitter_colors(rgb: Tensor, strength: float, rng: np.random.Generator) -> Tensor:
    """Change brightness, contrast, saturation and (slightly) hue, equally for all images.

    Args:
        rgb: ``(n, h, w, 3)`` uint8, views of one panorama or photo.
        strength: 0 to 1. The factors of the first three are uniform in 1 ± strength, hue is
            rotated by up to strength / 10 of the circle either way.
        rng: Random generator; four numbers are drawn.

    Returns:
        ``(n, h, w, 3)`` uint8.
    """
    from torchvision.transforms.v2 import functional  # slow to import, and for training only

    brightness, contrast, saturation = rng.uniform(1 - strength, 1 + strength, 3)
    hue = rng.uniform(-1, 1) * strength * _HUE_SHARE
    # As one tall image: with one mean for all, neighboring views keep equal colors at seams.
    image = rgb.flatten(0, 1).movedim(-1, 0)
    image = functional.adjust_brightness(image, brightness)
    image = functional.adjust_contrast(image, contrast)
    image = functional.adjust_saturation(image, saturation)
    image = functional.adjust_hue(image, hue)
    return image.movedim(0, -1).reshape(rgb.shape)
