"""Labels of panoramas: a second's worth, the share outside the network, and a folder of frames."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import nn

from benchmarks.gpu.device import DEVICE, QUICK, segformer, tried, way
from benchmarks.labels import NUM_CLASSES
from benchmarks.measuring import Goal, Row, Table, measure
from datamodules.core.inputs import RGB_NORMALIZATION
from models import FCNResNet
from tangent_train.checkpoints.scores import Scores
from tangent_train.checkpoints.trained import TrainedNetwork
from tangent_train.cli.processes import command_line, run_process
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.inference.predictor import Predictor, view_scores
from tangent_train.inference.views import InputImage, PanoramaViews
from tangent_train.rendering import equirect_to_tangent, tangent_to_labels

__all__ = ["predict"]

_NAMES = ("unknown", *map(str, range(NUM_CLASSES)))


def predict(quick: bool) -> Iterator[Table]:
    """2048×1024 and 4096×2048, in bf16, then 200 frames by ``tangent-predict``."""
    networks: dict[str, Callable[[], nn.Module]] = {
        "SegFormer-B0": lambda: segformer(NUM_CLASSES),
        "FCN-ResNet101": lambda: FCNResNet(3, NUM_CLASSES, depth=50 if quick else 101),
    }
    for level in (7,) if quick else (9, 10):
        for name, make in list(networks.items())[: 1 if quick else 2]:
            height, width = equirect_shape(level)
            rows = tried(f"{name}, {width}×{height}", partial(_rows, make(), level))
            if rows is None:
                continue
            table = Table(f"predict: {name}, bf16, {width}×{height}", rows)
            for row in rows[1:]:
                outside = 100 * (1 - 1 / table.ratio(row.name))
                table.goals.append(Goal(f"outside the network, percent, {row.name}", outside, 10))
            yield table
    frames = tried("a folder of frames", partial(_folder, 2 if quick else 200))
    if frames is not None:
        yield Table("predict: tangent-predict, of each frame", frames)


def _rows(network: nn.Module, level: int) -> list[Row]:
    """The network alone, `Predictor` as it is, and everything on the device."""
    shape = equirect_shape(level)
    settings = {"_target_": "tangent_train.rendering.TangentRepresentation", "base_level": 1}
    grid = TangentGrid(1, level)
    size = (grid.dim, grid.dim)
    trained = TrainedNetwork(
        network=Scores(network, NUM_CLASSES).eval(),
        class_names=_NAMES,
        inputs=("rgb",),
        normalization=RGB_NORMALIZATION,
        level=level,
        representation=settings,
        image_size=size,
    )
    image = InputImage(np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8))
    predictors = {
        blend: Predictor(trained, PanoramaViews(trained, blend=blend), DEVICE.type)
        for blend in ("feather", "nearest")
    }
    per_forward = max(1, 2**20 // grid.dim**2)
    random = torch.randn(min(per_forward, grid.num_images), 3, *size, device=DEVICE)
    random = random.contiguous(memory_format=torch.channels_last)

    def scores(views: Callable[[slice], torch.Tensor]) -> list[torch.Tensor]:
        parts = view_scores(trained.network, views, grid.num_images, per_forward)
        return [part for _, part in parts]

    def on_device() -> None:
        panorama = torch.from_numpy(image.rgb).to(DEVICE).movedim(-1, 0) / 255
        faces = np.arange(grid.num_images)
        found = scores(lambda part: equirect_to_tangent(panorama, grid, faces[part]))
        tangent_to_labels(torch.cat(found), grid, shape).byte().cpu()

    def labelled(predictor: Predictor) -> None:
        trained.labels(predictor.predict(image).labels())

    ways = [
        way("the network", lambda: scores(lambda part: random[: part.stop - part.start])),
        way("Predictor, feather", partial(labelled, predictors["feather"]), ours=True),
        way("Predictor, nearest", partial(labelled, predictors["nearest"]), ours=True),
        way("rendered and labelled on the device, nearest", on_device),
    ]
    with torch.autocast(DEVICE.type, torch.bfloat16, enabled=not QUICK):
        return measure(ways, 1 if QUICK else 5)


def _folder(count: int) -> list[Row]:
    """All of the command, its start too; float32, as the command computes."""
    from transformers import SegformerImageProcessor

    level = 7 if QUICK else 9
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        network: Any = segformer(NUM_CLASSES)
        network.network.save_pretrained(folder / "net")
        size = dict.fromkeys(("height", "width"), TangentGrid(1, level).dim)
        SegformerImageProcessor(size=size).save_pretrained(folder / "net")
        classes = folder / "classes.json"
        classes.write_text(json.dumps(list(_NAMES[1:])), encoding="utf-8")
        frames, checkpoint = folder / "frames", folder / "net.ckpt"
        frames.mkdir()
        shape = equirect_shape(level)
        noise = np.random.default_rng(0).integers(0, 256, (16, 32, 3), np.uint8)
        cv2.imwrite(str(frames / "0.jpg"), cv2.resize(noise, shape[::-1]))
        for number in range(1, count):
            shutil.copy(frames / "0.jpg", frames / f"{number}.jpg")
        given = ["network=huggingface", f"model={folder / 'net'}", f"classes={classes}"]
        given += [f"level={level}", "base_level=1", "normalization=imagenet"]
        _command("import", [*given, f"output={checkpoint}"], folder)
        given = [f"checkpoint={checkpoint}", f"input={frames}", f"device={DEVICE.type}"]
        rows = []
        for blend in ("feather", "nearest"):
            start = time.perf_counter()
            _command("predict", [*given, f"blend={blend}", f"output={folder / blend}"], folder)
            rows.append(Row(blend, [(time.perf_counter() - start) / count], True))
        return rows


def _command(name: str, arguments: list[str], folder: Path) -> None:
    status = run_process(command_line(name, arguments, folder))
    if status:
        raise RuntimeError(f"tangent-{name} ended with status {status}")
