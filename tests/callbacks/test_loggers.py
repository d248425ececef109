"""Scalars and pictures of one run in TensorBoard, CSV, offline W&B and MLflow."""

from __future__ import annotations

import csv
import json
import struct
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import (  # type: ignore[import-untyped]
    EventAccumulator,
)
from torch import nn

from datamodules import Stanford2D3DS
from datamodules.core.inputs import normalize
from datamodules.core.samples import render_inputs
from tangent_train.cli.trainer import build_trainer
from tangent_train.rendering import TangentRepresentation
from tangent_train.results.pictures import prediction_panel
from tangent_train.tasks import SegmentationTask
from tests.decoded import decoded
from tests.running import composed_settings
from tests.tasks.shapes import Shapes, shape_task

TANGENT = TangentRepresentation(base_level=0, level=4, faces_per_panorama=5)
STEPS = 3  # of an epoch: 6 panoramas, 2 at a time
VALIDATIONS = [STEPS - 1, 2 * STEPS - 1]

Scalars = dict[str, list[tuple[int, float]]]
"""Steps and values by name."""

Pictures = dict[str, list[NDArray[np.uint8]]]
"""Pictures in the order of their steps, by name without punctuation."""


def _fit(folder: Path, data: Any, task: Any, *overrides: str) -> None:
    """Train for two epochs."""
    (folder / "runs" / "mine" / "seed_0").mkdir(parents=True)
    typed = ("trainer.max_epochs=2", "trainer.log_every_n_steps=1", "trainer.accelerator=cpu")
    settings = composed_settings("train", *typed, "validation_images=2", *overrides)
    settings["trainer"] |= {"num_sanity_val_steps": 1, "enable_checkpointing": False}
    contents = {"config": {"network": {"widths": [4, 8]}, "seed": 0}}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        trainer = build_trainer(settings, Path("runs/mine/seed_0/P"), task, contents)
        trainer.fit(task, datamodule=data)


@pytest.fixture(scope="module")
def trained(
    stanford_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, SegmentationTask, Stanford2D3DS]:
    """Two epochs of panoramas with all loggers."""
    import wandb

    folder = tmp_path_factory.mktemp("trained")
    # Validation: 3 panoramas of 2 rooms.
    split: Any = {"val_fraction": 0.35, "seed": 3}
    data = Stanford2D3DS(stanford_root, TANGENT, batch_size=2, **split)
    torch.manual_seed(0)
    sgd = partial(torch.optim.SGD, lr=0.1)
    task = SegmentationTask(nn.Conv2d(4, 13, 1), TANGENT, data.class_names, sgd)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WANDB_MODE", "offline")
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        wandb_settings = composed_settings("train", "logger=wandb")["logger"]["wandb"]
        text = ", ".join(f"{n}: {'null' if v is None else v}" for n, v in wandb_settings.items())
        _fit(folder, data, task, "logger=many", f"+logger.wandb={{{text}}}")
        wandb.finish()
    return folder, task, data


def _events(folder: Path) -> EventAccumulator:
    events = EventAccumulator(
        str(folder / "runs/mine/seed_0/P/tensorboard"), size_guidance={"images": 0}
    )
    events.Reload()
    return events


def _of_tensorboard(folder: Path) -> tuple[Scalars, Pictures]:
    events = _events(folder)
    scalars = {t: [(e.step, e.value) for e in events.Scalars(t)] for t in events.Tags()["scalars"]}
    pictures = {
        _plain(tag): [decoded(event.encoded_image_string) for event in events.Images(tag)]
        for tag in events.Tags()["images"]
    }
    return scalars, pictures


def _of_csv(folder: Path) -> Scalars:
    scalars: Scalars = defaultdict(list)
    path = folder / "runs/mine/seed_0/P/csv/version_0/metrics.csv"
    for row in csv.DictReader(path.read_text().splitlines()):
        step = int(row.pop("step"))
        for name, value in row.items():
            if value:
                scalars[name].append((step, float(value)))
    return scalars


def _wandb_records(folder: Path) -> Iterator[Any]:
    """Records of an offline run: a file in LevelDB's format of logs, after 7 bytes."""
    from wandb.proto.wandb_internal_pb2 import Record  # type: ignore[attr-defined]

    (path,) = folder.glob("runs/mine/seed_0/P/wandb/offline-run-*/*.wandb")
    content, position, whole = path.read_bytes(), 7, b""
    while position < len(content):
        rest = 2**15 - position % 2**15
        if rest < 7:
            position += rest
            continue
        _, length, kind = struct.unpack_from("<IHB", content, position)
        whole += content[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # the whole record, or its last part
            yield Record.FromString(whole)
            whole = b""


def _of_wandb(folder: Path) -> tuple[Scalars, Pictures]:
    scalars: Scalars = defaultdict(list)
    pictures: Pictures = defaultdict(list)
    (media,) = folder.glob("runs/mine/seed_0/P/wandb/offline-run-*/files")
    for record in _wandb_records(folder):
        if record.WhichOneof("record_type") != "history":
            continue
        row: dict[str, dict[str, Any]] = defaultdict(dict)
        for item in record.history.item:
            name, *field = [item.key] if item.key else item.nested_key
            row[name][".".join(field)] = json.loads(item.value_json)
        step = row.pop("trainer/global_step")[""]
        for name, fields in row.items():
            for file in fields.get("filenames", []):
                pictures[_plain(name)].append(decoded((media / file).read_bytes()))
            if "" in fields and not name.startswith("_"):
                scalars[name].append((step, fields[""]))
    return scalars, pictures


def _of_mlflow(folder: Path) -> tuple[Scalars, Pictures, Any]:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"sqlite:///{folder}/mlflow.db")
    (experiment,) = client.search_experiments(filter_string="name = 'tangent-train'")
    (run,) = client.search_runs([experiment.experiment_id])
    scalars = {
        name: [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for name in run.data.metrics
    }
    pictures: Pictures = {}
    for path in sorted(
        folder.glob("mlruns/**/images/*.png"), key=lambda p: int(p.name.split("+")[2])
    ):
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        pictures.setdefault(_plain(path.name.split("+")[0]), []).append(image)
    return scalars, pictures, run


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name))


def _without_epochs(scalars: Scalars) -> Scalars:
    """W&B and CSV files have epoch and learning rates in rows of their own."""
    return {name: sorted(values) for name, values in scalars.items() if name != "epoch"}


def test_all_loggers_hold_the_same_scalars_and_pictures(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder = trained[0]
    expected, pictures = _of_tensorboard(folder)
    assert {"train/loss", "val/miou", "lr-SGD"} < expected.keys()
    assert [step for step, _ in expected["val/miou"]] == VALIDATIONS
    assert [step for step, _ in expected["train/loss"]] == list(range(2 * STEPS))
    assert any(name.startswith("val_iou/") for name in expected)
    expected = _without_epochs(expected)
    others = {
        "csv": _of_csv(folder),
        "wandb": _of_wandb(folder)[0],
        "mlflow": _of_mlflow(folder)[0],
    }
    for logger, found in others.items():
        assert _without_epochs(found).keys() == expected.keys(), logger
        for name, values in expected.items():
            assert np.allclose(found[name], values, rtol=1e-6), (logger, name)
    assert [len(shown) for shown in pictures.values()] == [2, 2]
    for logger, shown in (("wandb", _of_wandb(folder)[1]), ("mlflow", _of_mlflow(folder)[1])):
        assert shown.keys() == pictures.keys(), logger
        for name, images in pictures.items():
            np.testing.assert_array_equal(shown[name], images, err_msg=f"{logger} {name}")


def test_hyperparameters_name_and_group_are_logged_once(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder = trained[0]
    run = _of_mlflow(folder)[2]
    assert run.data.params == {"network.widths": "[4, 8]", "seed": "0"}
    assert run.info.run_name == "mine/seed_0/P"
    assert run.data.tags["group"] == "mine"
    records = list(_wandb_records(folder))
    (of_run,) = [r.run for r in records if r.WhichOneof("record_type") == "run"]
    assert (of_run.display_name, of_run.run_group) == ("mine/seed_0/P", "mine")
    files = folder / "runs/mine/seed_0/P"
    for path in (files / "tensorboard/hparams.yaml", files / "csv/version_0/hparams.yaml"):
        assert "network.widths" in path.read_text()


def test_the_same_images_are_shown_after_every_validation(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    shown, source = _of_tensorboard(folder)[1], data.dataset("val")
    assert len(source) == 3
    chosen = {_plain(f"val_images/{source.name(k)}"): k for k in (0, 2)}
    assert shown.keys() == chosen.keys(), "first and last of 3"
    for tag, index in chosen.items():
        panorama = source.read(index)
        normalization: Any = data.normalization
        inputs = render_inputs(panorama, TANGENT.view_sets()[0], data.inputs)
        images = normalize(inputs, normalization, data.inputs)
        labels = task.predict_labels(images, (32, 64)).numpy()
        expected = prediction_panel(panorama.rgb, panorama.labels, labels, data.class_names)
        np.testing.assert_array_equal(shown[tag][-1], expected)


def test_figures_of_every_class_are_those_of_numpy(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    scalars = _of_csv(folder)
    matrix = task.result.pixels
    present = [k for k in range(1, 14) if matrix[k].sum()]
    named = {f"val_iou/{data.class_names[k]}": k for k in present}
    assert sorted(n for n in scalars if n.startswith("val_iou/")) == sorted(named)
    assert named, "no class to compare"
    for tag, k in named.items():
        union = matrix[k].sum() + matrix[1:, k].sum() - matrix[k, k]
        assert scalars[tag][-1][1] == pytest.approx(matrix[k, k] / union, rel=1e-6)
    mean = np.mean([scalars[tag][-1][1] for tag in named])
    assert mean == pytest.approx(scalars["val/miou"][-1][1], rel=1e-6)


def test_the_validation_loss_is_that_of_all_views_normalized_as_in_training(
    trained: tuple[Path, SegmentationTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    total, norm, source = 0.0, 0.0, data.dataset("val")
    normalization: Any = data.normalization
    for index in range(len(source)):
        panorama, (views,) = source.read(index), TANGENT.view_sets()
        inputs = render_inputs(panorama, views, data.inputs)
        with torch.no_grad():
            scores = task.network(normalize(inputs, normalization, data.inputs)).double()
        labels = views.render(panorama.labels, "nearest").astype(np.int64)
        weights = np.insert(task.class_weights.double().numpy(), 0, 0)[labels]
        chosen = scores.log_softmax(1).gather(1, torch.tensor(labels).clamp(min=1)[:, None] - 1)
        total -= float((chosen[:, 0].numpy() * weights).sum())
        norm += float(weights.sum())
    assert _of_csv(folder)["val/loss"][-1][1] == pytest.approx(total / norm, rel=1e-5)


def test_shapes_have_accuracies_and_no_unknown_class(tmp_path: Path) -> None:
    task: Any = shape_task()
    _fit(tmp_path, Shapes(), task, "logger=csv", "validation_images=0")
    scalars = _of_csv(tmp_path)
    of_classes = [scalars[f"val_accuracy/{name}"] for name in task.class_names]
    assert [step for step, _ in of_classes[0]] == VALIDATIONS
    mean = np.mean([values[-1][1] for values in of_classes])
    assert mean == pytest.approx(scalars["val/class_accuracy"][-1][1], rel=1e-6)
    images = torch.stack([shape.images for shape in Shapes().shapes])
    labels = torch.stack([shape.label for shape in Shapes().shapes])
    with torch.no_grad():
        loss = torch.nn.functional.cross_entropy(task.network(images), labels)
    assert scalars["val/loss"][-1][1] == pytest.approx(float(loss), rel=1e-5)
