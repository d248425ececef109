"""Second pass of ``tangent-predict``: the depth of all images at one scale."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import groupby
from pathlib import Path, PurePath
from typing import Any, Literal

import numpy as np
import torch

from tangent_train.console import print_text
from tangent_train.errors import listed
from tangent_train.heads.distance import POSE_UNIT
from tangent_train.heads.scales import Scales, frame_scales, pose_scales
from tangent_train.io.jobs import Job
from tangent_train.keypoints.colmap import poses_from
from tangent_train.rendering.resampling import resize


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
        self.facts = {name: {**of, "scale": None} for name, of in facts.items()}
        groups = [[*names] for _, names in groupby(facts, lambda name: PurePath(name).parent)]
        known, unit = dict[str, Any](), dict[str, str]()
        fit: Callable[..., Scales] = frame_scales
        if isinstance(self._across, Path):
            poses = poses_from(self._across)
            known = {str(PurePath(file).with_suffix("")): of for file, of in poses.items()}
            groups = [[name for name in facts if name in known]]
            fit, unit = pose_scales, {"unit": POSE_UNIT}
        for names in (names for names in groups if len(names) > 1):
            maps = [resize(np.load(self.file(name)), (128, 256), "nearest") for name in names]
            of_names = zip(*(known[name] for name in names if name in known), strict=True)
            found, steps = fit(np.stack(maps), *of_names)
            for name, scale in zip(names, found.tolist(), strict=True):
                if scale > 0:
                    self.facts[name] |= {"scale": scale, **unit}
            if count := np.sum(found > 0):
                text = "{:.1%} before, {:.1%} after".format(*steps)
                print_text(f"One scale for {count} images: median step {text}.")
        if alone := [name for name, of in self.facts.items() if of["scale"] is None]:
            print_text(f"Nothing determines the scale of {listed(alone)}.")

    def scaled(self, job: Job, _: Callable[[float], object]) -> tuple[Any, ...]:
        """Return an image at its scale, as the prediction does."""
        facts = self.facts[job.name]
        pixels = np.load(self.file(job.name)) * np.float32(facts["scale"] or 1)
        return job.value, (torch.from_numpy(pixels), facts)
