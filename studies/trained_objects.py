"""A network of objects, trained for minutes on synthetic rooms (docs/explanation/objects.md).

``python -m studies.trained_objects`` renders rooms, trains the network on their views, and scores
the objects of held-out rooms with and without joining.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional as F

from datamodules.core.inputs import Normalization
from datamodules.stanford2d3ds.files import CLASSES, THINGS, Area
from datamodules.synthrooms.datamodule import RoomSettings, SynthRooms
from models import UNet
from models.segments import Segments, front_segments
from studies.output import FOLDER, Row, save
from tangent_train.cli import main
from tangent_train.config.build import build_from_config
from tangent_train.heads.objects import join_objects
from tangent_train.inference.views import view_settings
from tangent_train.metrics.panoptic import LABEL
from tangent_train.photo_networks import PhotoNetwork, import_network

SIDE, LEVEL = 192, 7
"""Pixels of a side of the views, and the level of the panoramas."""

STAGES = (800, 20.0, 0.05), (300, 200.0, 0.01)
"""Steps, and weights of the losses of centers and offsets; the second are Panoptic-DeepLab's."""

PANORAMAS = 4
"""Panoramas in a step, each with two views."""

ROOMS: dict[Area, int] = {"1": 24, "2": 24, "3": 24, "4": 24, "5a": 10, "5b": 10, "6": 24}
"""Rooms of each area; 5a and 5b are for testing."""

DATA, FILE = Path("data/rooms_objects"), FOLDER / "objects" / "centers.ckpt"
VARIANTS = {
    "joined": (0.3, False),
    "not joined": (1.1, False),
    "joined connected parts": (0.3, True),
}
"""Smallest overlap of masks that join; True for parts without centers.

0.3 is the default, and nothing reaches 1.1.
"""

_LEAST_PIXELS = 30
_SIGMA = 3.0
"""Width of the heat around a center, in pixels at half the resolution."""

_LEAST_HEAT = 0.2


class Centers(nn.Module):
    """Classes, a heat map of the objects' centers, and each pixel's offset to its center.

    After Panoptic-DeepLab (Cheng et al., CVPR 2020), with a UNet at half the resolution.
    """

    def __init__(self) -> None:
        super().__init__()
        stem = nn.Conv2d(3, 32, 4, 2, 1)
        self.network = nn.Sequential(stem, UNet(32, len(CLASSES) + 3, (32, 64, 128, 256)))
        self.size_multiple = 16

    def _maps(self, images: Tensor) -> Sequence[Tensor]:
        """Return scores, heat and offsets in pixels, at half the resolution."""
        with torch.autocast("cpu", torch.bfloat16):
            found = self.network((images * 4 - 2).contiguous(memory_format=torch.channels_last))
        scores, heat, offsets = found.float().split([len(CLASSES), 1, 2], 1)
        return scores, heat, offsets * (SIDE / 8)

    def losses(self, images: Tensor, codes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the losses of classes, centers and offsets.

        Args:
            images: Views ``(n, 3, h, w)``.
            codes: Panoptic maps of the views ``(n, h, w)``.
        """
        scores, heat, offsets = self._maps(images)
        codes = codes[:, ::2, ::2]
        grid, wanted = _pixels(codes.shape[1:]), torch.zeros_like(heat)
        shifts, inside = torch.zeros_like(offsets), torch.zeros_like(heat)
        for k, of_view in enumerate(codes):
            for value in of_view[of_view % LABEL > 0].unique():
                mask = of_view == value
                if mask.sum() < _LEAST_PIXELS // 4:
                    continue
                center = grid[:, mask].mean(1, keepdim=True)
                near = (grid - center[..., None]).square().sum(0) / (2 * _SIGMA**2)
                wanted[k, 0] = torch.maximum(wanted[k, 0], torch.exp(-near))
                shifts[k, :, mask] = center - grid[:, mask]
                inside[k, 0, mask] = 1
        distance = (offsets - shifts).abs() * inside
        of_classes = F.cross_entropy(scores, (codes // LABEL - 1).long(), ignore_index=-1)
        of_centers = (heat - wanted).square().mean()
        return of_classes, of_centers, distance.sum() / inside.sum().clamp(min=1)

    def forward(self, images: Tensor) -> dict[str, Any]:
        """Return scores of the classes, and `Segments`."""
        maps = [F.interpolate(of, scale_factor=2, mode="bilinear") for of in self._maps(images)]
        given = zip(maps[0].softmax(1), maps[1][:, 0], 2 * maps[2], strict=True)
        return {"out": maps[0], "segments": [self.segments(*of_view) for of_view in given]}

    def segments(self, shares: Tensor, heat: Tensor, offsets: Tensor) -> Segments:
        """Assign each pixel of a thing to the nearest center."""
        things = torch.tensor([CLASSES.index(name) for name in THINGS])
        is_peak = (heat == F.max_pool2d(heat[None], 11, 1, 5)[0]) & (heat > _LEAST_HEAT)
        is_thing = torch.isin(shares.argmax(0), things)
        masks = torch.zeros(0, *heat.shape, dtype=torch.bool)
        if is_peak.any():
            aimed = (_pixels(heat.shape) + offsets).flatten(1).T
            nearest = torch.cdist(aimed, is_peak.nonzero().float()).argmin(1).view_as(heat)
            masks = is_thing & (nearest == torch.arange(int(is_peak.sum()))[:, None, None])
        masks = masks[masks.sum((1, 2)) >= _LEAST_PIXELS]
        weights = masks.flatten(1).float()
        means = weights @ shares[things].flatten(1).T / weights.sum(1, keepdim=True)
        best = means.max(1)
        return front_segments(masks, things[best.indices], best.values)


def connected_parts(_: Centers, shares: Tensor, *others: Tensor) -> Segments:
    """Return the connected parts of each class, without centers."""
    labels, masks, classes = shares.argmax(0), [torch.zeros(0, *shares.shape[1:]) > 0], list[int]()
    for k in map(CLASSES.index, THINGS):
        parts, number = ndimage.label((labels == k).numpy())
        of_class = torch.from_numpy(parts) == torch.arange(1, number + 1)[:, None, None]
        masks.append(of_class[of_class.sum((1, 2)) >= _LEAST_PIXELS])
        classes += [k] * len(masks[-1])
    joint, of = torch.cat(masks), torch.tensor(classes, dtype=torch.int64)
    scores = (shares[of] * joint).sum((1, 2)) / joint.sum((1, 2))
    return front_segments(joint, of, scores)


def _pixels(size: Any) -> Tensor:
    """Return row and column ``(2, h, w)`` of each pixel."""
    return torch.stack(torch.meshgrid(*map(torch.arange, size), indexing="ij")).float()


def batches(seed: int = 0) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield views ``(n, 3, h, w)`` of training rooms, and their panoptic maps."""
    changes = {"level": LEVEL, "dim": SIDE, "faces_per_panorama": 2, "random_rotation": "yaw"}
    section = view_settings("horizontal_wide") | changes | {"mirror": True}
    views = build_from_config(section, "representation")
    settings: dict[str, Any] = {"inputs": ["rgb"], "labels": "panoptic", "in_memory": True}
    rooms = RoomSettings(rooms=ROOMS, height=2 << LEVEL)
    data = SynthRooms(DATA, views, rooms=rooms, seed=seed, **settings)
    data.prepare_data()
    samples, rng = data.dataset("train"), np.random.default_rng(seed)
    for epoch in count():
        order = rng.permutation(len(samples))
        for first in range(0, len(order) - PANORAMAS + 1, PANORAMAS):
            drawn = [samples[epoch, int(k)] for k in order[first : first + PANORAMAS]]
            images = torch.cat([sample.images[0] for sample in drawn]).permute(0, 3, 1, 2) / 255
            yield images, torch.cat([sample.labels for sample in drawn])


def train(network: Centers, seed: int, steps: int, *weights: float) -> None:
    """Train a network in one stage."""
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps)
    start, sums = time.process_time(), np.zeros(3)
    for step, batch in zip(range(1, steps + 1), batches(seed), strict=False):
        losses = network.losses(*batch)
        loss: Any = sum(w * part for w, part in zip((1, *weights), losses, strict=True))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        sums += [float(part.detach()) / 50 for part in losses]
        if step % 50 == 0:
            shown = "classes {:.3f}, centers {:.4f}, offsets {:.2f}".format(*sums)
            print(f"{step}: {shown}, {time.process_time() - start:.0f} CPU s", flush=True)
            sums[:] = 0


def write(network: Centers) -> None:
    """Write the file of a trained network."""
    settings = {"_target_": "studies.trained_objects.Centers"}
    unit, size = Normalization.of("unit", 3), (SIDE, SIDE)
    FILE.parent.mkdir(parents=True, exist_ok=True)
    photo = PhotoNetwork(network.eval(), settings, CLASSES, unit, size, "logits", things=THINGS)
    import_network(photo, FILE)


def evaluate(title: str) -> Row:
    """Return scores of things in the test rooms by pixels, in percent; the title is a variant."""
    overlap, is_parts = VARIANTS[title]
    folder = FILE.with_name(title)
    shutil.rmtree(folder, ignore_errors=True)
    rooms = [f"data.rooms.rooms.area_{area}={number}" for area, number in ROOMS.items()]
    arguments = [
        *("tangent-evaluate", "task=panoptic", f"checkpoint={FILE}", f"hydra.run.dir={folder}"),
        *("data=synthrooms", f"data.root={DATA}", f"data.rooms.height={2 << LEVEL}", *rooms),
        *(f"level={LEVEL}", "representation=horizontal_wide", f"representation.dim={SIDE}"),
        *("trust=studies.trained_objects", "trainer.accelerator=cpu", "panels=0", "logger=none"),
    ]
    join = partial(join_objects, least_overlap=overlap)
    segments = "studies.trained_objects.Centers.segments"
    with (
        mock.patch("tangent_train.heads.panoptic.join_objects", join),
        mock.patch(segments, connected_parts) if is_parts else nullcontext(),
        mock.patch.object(sys, "argv", arguments),
    ):
        main.evaluate()
    content = json.loads((folder / "results.json").read_text())
    scores, ends = content["scores"], content["intervals"]["pq_things"]
    things = [entry for entry in content["classes"] if entry["class"] in THINGS]
    pq = "{:.1f} [{:.1f}, {:.1f}]".format(*(100 * v for v in (scores["pq_things"], *ends)))
    others = {name.upper(): np.nanmean([e[name] for e in things]) for name in ("sq", "rq")}
    others |= {"PQ across ±180°": scores["pq_seam"], "PQ near poles": scores["pq_poles"]}
    others["PQ of stuff"] = scores["pq_stuff"]
    return {"objects": title, "PQ": pq} | {k: f"{100 * v:.1f}" for k, v in others.items()}


if __name__ == "__main__":
    if not FILE.exists():
        torch.manual_seed(0)
        trained = Centers().train().to(memory_format=torch.channels_last)
        for number, stage in enumerate(STAGES):
            train(trained, number, *stage)
        write(trained)
    save("trained_objects", [evaluate(title) for title in VARIANTS])
