"""Predict panoramas: time, its share outside the network, and a folder of video frames."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.labels import NUM_CLASSES
from benchmarks.measuring import DEVICE, Alternative, Goal, Row, Table, measure
from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.cli.processes import command_line
from tangent_train.config.build import build_from_config
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor, scored_views, views_per_forward
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.photo_networks import PhotoNetwork, import_network


def predict(quick: bool) -> Iterator[Table]:
    """Predict 2048×1024 and 4096×2048 in bf16, then 200 frames with ``tangent-predict``."""
    segformer = {"_target_": "models.HuggingFaceNetwork", "config": {"model_type": "segformer"}}
    fcn = {"_target_": "models.FCNResNet", "in_channels": 3, "depth": 101}
    networks: dict[str, dict[str, Any]] = {"SegFormer-B0": segformer, "FCN-ResNet101": fcn}
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "net.ckpt"
        for level in (7,) if quick else (9, 10):
            for name, settings in list(networks.items())[: 1 if quick else 2]:
                height, width = equirect_shape(level)
                rows = _rows(_imported(settings, level, path), level, 1 if quick else 5)
                table = Table(f"predict: {name}, bf16, {width}×{height}", rows)
                for row in rows[1:]:
                    outside = 100 * (1 - 1 / table.ratio(row.name))
                    goal = f"outside the network, percent, {row.name}"
                    table.goals.append(Goal(goal, outside, 10))
                yield table
        _imported(networks["SegFormer-B0"], 7 if quick else 9, path)
        row = _folder(path, 7 if quick else 9, 2 if quick else 200)
        yield Table("predict: time per frame", [row])


def _imported(settings: dict[str, Any], level: int, path: Path) -> LoadedNetwork:
    """Write a checkpoint with an untrained network for tangent images of a level."""
    settings |= {"num_classes": NUM_CLASSES}
    names, side = [f"class {k}" for k in range(NUM_CLASSES)], TangentGrid(1, level).dim
    network, normalization = build_from_config(settings, "network"), Normalization.of("imagenet", 3)
    photo = PhotoNetwork(network, settings, names, normalization, (side, side))
    return import_network(photo, path, levels=level, base_level=1)


def _rows(trained: LoadedNetwork, level: int, rounds: int) -> list[Row]:
    """Time the network alone and `Predictor`, with all data on the device."""
    shape, grid = equirect_shape(level), TangentGrid(1, level)
    image = InputImage(np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8))
    per_forward = views_per_forward((grid.dim, grid.dim))
    count = min(per_forward, grid.num_images)
    random = torch.randn(count, 3, grid.dim, grid.dim, device=DEVICE)
    random = random.contiguous(memory_format=torch.channels_last)

    def scores(views: Callable[[slice], torch.Tensor]) -> list[torch.Tensor]:
        sets = [(range(grid.num_images), views, None)]
        parts = scored_views(trained.network, sets, per_forward)
        return [part for _, part in parts]

    def labeled(predictor: Predictor) -> None:
        predictor.predict(image).pixels().cpu()

    alternatives = [
        Alternative("the network", lambda: scores(lambda part: random[: part.stop - part.start]))
    ]
    for blend in ("feather", "nearest"):
        views = ViewSelector(trained, blend=blend)
        call = partial(labeled, Predictor(trained, head_of(trained), views, DEVICE.type))
        alternatives.append(Alternative(f"Predictor, {blend}", call, is_ours=True))
    with torch.autocast(DEVICE.type, torch.bfloat16, enabled=DEVICE.type == "cuda"):
        return measure(alternatives, rounds)


def _folder(checkpoint: Path, level: int, count: int) -> Row:
    """Time the whole command in float32, including its start."""
    folder, frames = checkpoint.parent, checkpoint.with_name("frames")
    frames.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (16, 32, 3), np.uint8)
    cv2.imwrite(str(frames / "0.jpg"), cv2.resize(noise, equirect_shape(level)[::-1]))
    for number in range(1, count):
        shutil.copy(frames / "0.jpg", frames / f"{number}.jpg")
    given = [f"checkpoint={checkpoint}", f"input={frames}", f"output={folder / 'labels'}"]
    start = time.perf_counter()
    line = command_line("predict", [*given, f"device={DEVICE.type}"], folder)
    subprocess.run(line, check=True)
    return Row("tangent-predict", [(time.perf_counter() - start) / count], True)
