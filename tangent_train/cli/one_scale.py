"""Second pass of ``tangent-predict``: the depth of all images at one scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import groupby
from pathlib import Path, PurePath
from typing import Any, Literal

import numpy as np
import torch

from tangent_train.console import print_text
from tangent_train.errors import listed
from tangent_train.geometry import PanoramaPose
from tangent_train.heads.scales import frame_scales, pose_scales
from tangent_train.io.jobs import Job
from tangent_train.keypoints.colmap import poses_from
from tangent_train.rendering.resampling import resize

_MOST_LOG_SCALE = 3.0
"""Logarithm of a scale above which nothing determines it: without parallax, all large ones fit."""


class OneScale:
    """Scales of images, fitted to each other once all of them are predicted.

    Args:
        across: Setting `align_across`.
        folder: Folder of the distances before, which are kept.

    Attributes:
        facts: Facts about each image for its summary, after `fit`.
    """

    def __init__(self, across: Literal["frames"] | Path, folder: Path) -> None:
        self._across, self._folder = across, folder
        self.facts: dict[str, dict[str, Any]] = {}

    def file(self, name: str) -> Path:
        """Return the file of the distances of an image before."""
        return self._folder / f"{name}.npy"

    def fit(self, facts: Mapping[str, Mapping[str, Any]]) -> None:
        """Fit the scales, and print what was found.

        Args:
            facts: Facts about all images, in their order.
        """
        poses: dict[str, PanoramaPose] = {}
        groups = [[*names] for _, names in groupby(facts, lambda name: PurePath(name).parent)]
        if isinstance(self._across, Path):
            read = poses_from(self._across)
            poses = {str(PurePath(file).with_suffix("")): pose for file, pose in read.items()}
            groups = [[name for name in facts if name in poses]]
        scales: dict[str, float] = {}
        for group in (group for group in groups if len(group) > 1):
            maps = [resize(np.load(self.file(name)), (128, 256), "nearest") for name in group]
            of_group = [poses[name] for name in group if name in poses]
            fit = partial(pose_scales, poses=of_group) if of_group else frame_scales
            found, steps = fit(np.stack(maps))
            if np.abs(np.log(found)).max() > _MOST_LOG_SCALE:
                continue
            scales |= zip(group, found.tolist(), strict=True)
            text = "{:.1%} before, {:.1%} after".format(*steps)
            print_text(f"One scale for {len(group)} images: median step between them {text}.")
        if alone := [name for name in facts if name not in scales]:
            print_text(f"Nothing determines the scale of {listed(alone)}.")
        self.facts = {name: {**of, "scale": scales.get(name, 1.0)} for name, of in facts.items()}

    def scaled(self, job: Job, _: Callable[[float], object]) -> tuple[Any, ...]:
        """Return an image at its scale, as the prediction does."""
        facts = self.facts[job.name]
        pixels = np.load(self.file(job.name)) * np.float32(facts["scale"])
        return job.value, (torch.from_numpy(pixels), facts)
