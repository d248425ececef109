"""Data sets of one split: reading images, and rendering samples from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from datamodules.core.images import Image
from datamodules.core.loading import sample_key, sample_rng
from datamodules.core.problems import Problems
from datamodules.core.samples import (
    EvaluationSample,
    Inputs,
    TrainingSample,
    as_tensor,
    for_torch,
    jitter_colors,
    render_inputs,
    view_ray_lengths,
    world_rays,
)
from datamodules.core.splits import Split
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering.representations.views import Views
from tangent_train.threads import in_threads


class SplitDataset(Dataset[Any]):
    """The images or shapes of one split, decoded; a subclass renders samples from them.

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
            self._keep()

    def __len__(self) -> int:
        return len(self.files)

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

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the samples of epoch 0."""
        return map(self.__getitem__, range(len(self)))

    def _keep(self) -> None:
        """Read everything now: where loaders fork their workers, these share the memory.

        Every process of a distributed run keeps a copy.
        """
        problems = Problems()

        def keep(index: int) -> Any:
            with problems.noted(self.name(index)):
                image = self.read(index)
                # Copies, because arrays that are views of a file keep it open.
                return image._make(np.array(a) if isinstance(a, np.ndarray) else a for a in image)

        kept = list(in_threads(keep, range(len(self))))
        problems.refuse(self.data.root)
        self._kept = kept


class ImageDataset(SplitDataset):
    """Views of panoramas or photos, by index or (epoch, index); an index alone means epoch 0.

    A sample for training holds random views, which depend on seed, epoch and index only. A sample
    for validation or test holds the views of all view sets.
    """

    def __getitem__(self, key: int | tuple[int, int]) -> Any:
        epoch, index = sample_key(key, len(self))
        image, data = self.read(index), self.data
        sampler = image.sampler(data.representation)
        if self.split != "train":
            return self._evaluation_sample(image, sampler.view_sets(image.valid), index)
        rng = sample_rng((data.seed, data.sampling_seed), epoch, index)
        views = sampler.sample(rng, image.valid)
        rgb, *others = render_inputs(image, views, data.inputs)
        if data.color_jitter:
            rgb = jitter_colors(rgb, data.color_jitter, rng)
        labels = as_tensor(for_torch(views.render(image.labels, "nearest")))
        rays = torch.from_numpy(world_rays(views, image.up))
        return TrainingSample((rgb, *others), labels, rays, view_ray_lengths([views], image), index)

    def _evaluation_sample(
        self, image: Image, view_sets: Sequence[Views], index: int
    ) -> EvaluationSample[Inputs]:
        of_sets = [render_inputs(image, views, self.data.inputs) for views in view_sets]
        images = tuple(map(torch.cat, zip(*of_sets, strict=True)))
        rotation = np.eye(3) if image.up is None else upright_rotation(image.up)
        target = torch.tensor(for_torch(image.target(self.data.representation)))
        valid = torch.tensor(np.empty((0, 0), np.bool_) if image.valid is None else image.valid)
        lengths = view_ray_lengths(view_sets, image)
        return EvaluationSample(images, target, torch.from_numpy(rotation), lengths, valid, index)

    def labels(self, index: int) -> NDArray[Any]:
        """Return the labels of the valid pixels of an image, without decoding colors."""
        is_masked = getattr(self.data, "mask", None) is not None
        if self._kept or self.data.cache is not None or is_masked:
            image = self.read(index)
            return image.labels if image.valid is None else image.labels[image.valid]
        labels: NDArray[Any] = self.data.read_labels(self.files[index])
        return labels
