"""Predict panoramas: time, its share outside the network, and a folder of video frames."""

from __future__ import annotations

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
from torch.profiler import ProfilerActivity, profile

from benchmarks.labels import NUM_CLASSES
from benchmarks.measuring import DEVICE, ON_GPU, Alternative, Goal, Row, Table, busy_s, measure
from datamodules.core.inputs import Normalization
from datamodules.core.label_map import DISTANCE
from models import HuggingFaceDepthNetwork
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.cli.predict import predict as run_predict
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import PredictSettings
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor, scored_views, views_per_forward
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.photo_networks import PhotoNetwork, import_network


def predict(quick: bool) -> Iterator[Table]:
    """Predict 2048×1024 and 4096×2048 in bf16, then a folder with ``tangent-predict``."""
    segformer = {"_target_": "models.HuggingFaceNetwork", "config": {"model_type": "segformer"}}
    fcn = {"_target_": "models.FCNResNet", "in_channels": 3, "depth": 101}
    networks: dict[str, dict[str, Any]] = {"SegFormer-B0": segformer, "FCN-ResNet101": fcn}
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "net.ckpt"
        for level in (7,) if quick else (9, 10):
            loaded = {name: partial(_imported, of, level, path) for name, of in networks.items()}
            loaded["Depth Anything V2 Small"] = partial(_depth, level)
            for name, load in loaded.items():
                if quick and name == "FCN-ResNet101":
                    continue
                yield _table(name, load(), level, 1 if quick else 5)
        _imported(networks["SegFormer-B0"], 7 if quick else 9, path)
        yield from _folder(path, 7 if quick else 9, 2 if quick else 200)


def _table(name: str, loaded: LoadedNetwork, level: int, rounds: int) -> Table:
    """Compare a network with the prediction of a panorama."""
    height, width = equirect_shape(level)
    rows = _rows(loaded, level, rounds)
    table = Table(f"predict: {name}, bf16, {width}×{height}", rows)
    for row in rows[1:]:
        outside = 100 * (1 - 1 / table.ratio(row.name))
        table.goals.append(Goal(f"outside the network, percent, {row.name}", outside, 10))
    return table


def _depth(level: int) -> LoadedNetwork:
    """Return an untrained depth network for tangent images of a level."""
    settings = {"_target_": "tangent_train.rendering.TangentRepresentation", "base_level": 1}
    settings |= {"level": level, "crop_multiple": 14}
    size = build_from_config(settings, "representation").image_size
    return LoadedNetwork(
        module=HuggingFaceDepthNetwork({"model_type": "depth_anything"}).eval(),
        predicts=DISTANCE,
        class_names=(),
        inputs=("rgb",),
        normalization=Normalization.of("imagenet", 3),
        level=level,
        representation=settings,
        image_size=size,
        depth_kind="relative_disparity",
    )


def _imported(settings: dict[str, Any], level: int, path: Path) -> LoadedNetwork:
    """Write a checkpoint with an untrained network for tangent images of a level."""
    settings |= {"num_classes": NUM_CLASSES}
    names, side = [f"class {k}" for k in range(NUM_CLASSES)], TangentGrid(1, level).dim
    network, normalization = build_from_config(settings, "network"), Normalization.of("imagenet", 3)
    photo = PhotoNetwork(network, settings, names, normalization, (side, side))
    return import_network(photo, path, levels=level, base_level=1)


def _rows(trained: LoadedNetwork, level: int, rounds: int) -> list[Row]:
    """Time the network alone and `Predictor`, with all data on the device."""
    shape = equirect_shape(level)
    image = InputImage(np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8))
    size = trained.image_size
    per_forward, number = views_per_forward(size), TangentGrid(1, level).num_images
    random = torch.randn(min(per_forward, number), 3, *size, device=DEVICE)
    random = random.contiguous(memory_format=torch.channels_last)

    def scores(views: Callable[[slice], torch.Tensor]) -> list[torch.Tensor]:
        sets = [(range(number), views, None)]
        parts = scored_views(trained.network, sets, per_forward)
        return [part for _, part, _ in parts]

    def predicted(predictor: Predictor) -> None:
        predictor.predict(image).pixels()

    alternatives = [
        Alternative("the network", lambda: scores(lambda part: random[: part.stop - part.start]))
    ]
    compilers: dict[str, Any] = {
        "feather": None,
        "nearest": None,
        "nearest, CUDA graphs": {"mode": "reduce-overhead"},
    }
    for name, compiler in compilers.items():
        blend: Any = name.partition(",")[0]
        views = ViewSelector(trained, blend=blend)
        predictor = Predictor(trained, head_of(trained), views, DEVICE.type, compile=compiler)
        if compiler is None or ON_GPU:
            call = partial(predicted, predictor)
            alternatives.append(Alternative(f"Predictor, {name}", call, is_ours=True))
    with torch.autocast(DEVICE.type, torch.bfloat16, enabled=DEVICE.type == "cuda"):
        return measure(alternatives, rounds)


def _folder(checkpoint: Path, level: int, count: int) -> Iterator[Table]:
    """Run the command in float32 on copies of a panorama: time, and work of the device."""
    folder, frames = checkpoint.parent, checkpoint.with_name("frames")
    frames.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (16, 32, 3), np.uint8)
    cv2.imwrite(str(frames / "0.jpg"), cv2.resize(noise, equirect_shape(level)[::-1]))
    for number in range(1, count):
        shutil.copy(frames / "0.jpg", frames / f"{number}.jpg")
    shared: Any = {"checkpoint": checkpoint, "device": DEVICE.type, "report": 0}
    first, every = frames / "0.jpg", frames
    settings = [
        PredictSettings(**shared, input=files, output=folder / f"labels {k}")
        for k, files in enumerate((first, every))
    ]
    run_predict(settings[0])  # loads the network's libraries and fills the cache of tables
    with profile(
        activities=[ProfilerActivity.CUDA if ON_GPU else ProfilerActivity.CPU]
    ) as profiler:
        start = time.perf_counter()
        run_predict(settings[1])
        taken = time.perf_counter() - start
    yield Table(
        "predict: time per panorama of a folder", [Row("tangent-predict", [taken / count], True)]
    )
    busy = Row("tangent-predict", [100 * busy_s(profiler) / taken], True)
    goal = Goal("busy, percent", busy.median, 90, True)
    yield Table("predict: share of the time in which the device works", [busy], "%", [goal])
