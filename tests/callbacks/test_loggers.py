"""Scalars and pictures of one run in TensorBoard, CSV and MLflow; pictures in W&B."""

from __future__ import annotations

import csv
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, WandbLogger
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import (  # type: ignore[import-untyped]
    EventAccumulator,
)
from torch import nn

from datamodules.core.dataset import render_inputs
from datamodules.core.inputs import normalize
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.callbacks.loggers import start_loggers
from tangent_train.callbacks.pictures import log_image
from tangent_train.cli.run import Run
from tangent_train.errors import SettingError
from tangent_train.heads.pictures import prediction_panel
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import PixelTask
from tests.decoded import decoded
from tests.running import composed_settings
from tests.tasks.builders import predict_labels, segmentation_task

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
    more = {"num_sanity_val_steps": 1, "enable_checkpointing": False}
    settings = settings.model_copy(update={"trainer": settings.trainer | more})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(Run, "contents", lambda _: {})
        trainer = Run(Path("runs/mine/seed_0/P"), settings, data, task).trainer()
        trainer.fit(task, datamodule=data)


@pytest.fixture(scope="module")
def trained(
    stanford_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, PixelTask, Stanford2D3DS]:
    """Two epochs of panoramas with all loggers."""
    folder = tmp_path_factory.mktemp("trained")
    # Validation: 3 panoramas of 2 rooms.
    split: Any = {"val_fraction": 0.35, "seed": 3}
    data = Stanford2D3DS(stanford_root, TANGENT, batch_size=2, **split)
    torch.manual_seed(0)
    sgd = partial(torch.optim.SGD, lr=0.1)
    task = segmentation_task(nn.Conv2d(4, 13, 1), TANGENT, data.class_names, sgd)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        _fit(folder, data, task, "logger=many")
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


def _of_mlflow(folder: Path) -> tuple[Scalars, Pictures, Any]:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"sqlite:///{folder}/runs/mine/seed_0/P/mlflow.db")
    (experiment,) = client.search_experiments(filter_string="name = 'tangent-train'")
    (run,) = client.search_runs([experiment.experiment_id])
    scalars = {
        name: [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for name in run.data.metrics
    }
    pictures: Pictures = {}
    for path in sorted(
        folder.rglob("mlflow_files/**/images/*.png"), key=lambda p: int(p.name.split("+")[2])
    ):
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        pictures.setdefault(_plain(path.name.split("+")[0]), []).append(image)
    return scalars, pictures, run


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name))


def _without_epochs(scalars: Scalars) -> Scalars:
    """CSV files have epoch and learning rates in rows of their own."""
    return {name: sorted(values) for name, values in scalars.items() if name != "epoch"}


def test_all_loggers_hold_the_same_scalars_and_pictures(
    trained: tuple[Path, PixelTask, Stanford2D3DS],
) -> None:
    folder = trained[0]
    expected, pictures = _of_tensorboard(folder)
    assert {"train/loss", "val/miou", "lr-SGD"} < expected.keys()
    assert [step for step, _ in expected["val/miou"]] == VALIDATIONS
    assert [step for step, _ in expected["train/loss"]] == list(range(2 * STEPS))
    assert any(name.startswith("val_iou/") for name in expected)
    expected = _without_epochs(expected)
    in_mlflow, shown, _ = _of_mlflow(folder)
    for logger, found in (("csv", _of_csv(folder)), ("mlflow", in_mlflow)):
        assert _without_epochs(found).keys() == expected.keys(), logger
        for name, values in expected.items():
            assert np.allclose(found[name], values, rtol=1e-6), (logger, name)
    assert [len(images) for images in pictures.values()] == [2, 2]
    assert shown.keys() == pictures.keys()
    for name, images in pictures.items():
        np.testing.assert_array_equal(shown[name], images, err_msg=name)
    wandb: Any = create_autospec(WandbLogger, instance=True)
    log_image(wandb, "val_images/a", images[0], 3)
    wandb.log_image.assert_called_once_with("val_images/a", [images[0]], 3)


def test_hyperparameters_name_and_group_are_logged_once(
    trained: tuple[Path, PixelTask, Stanford2D3DS],
) -> None:
    folder = trained[0]
    run = _of_mlflow(folder)[2]
    assert run.data.params["network.widths"] == "[16, 32, 64, 128, 256, 256]"
    assert run.info.run_name == "mine/seed_0/P"
    assert run.data.tags["group"] == "mine"
    files = folder / "runs/mine/seed_0/P"
    for path in (files / "tensorboard/hparams.yaml", files / "csv/version_0/hparams.yaml"):
        assert "network.widths" in path.read_text()


def _log(folder: Path, steps: range, *options: str, checkpoint: Path | None = None) -> list[Any]:
    """Log a value at some steps, as a run that is then killed."""
    settings = composed_settings("train", *options)
    hyperparameters = {"resumed": str(checkpoint)}  # MLflow refuses that they change
    loggers = start_loggers(settings.logger, folder, hyperparameters, checkpoint)
    for logger in loggers:
        for step in steps:
            logger.log_metrics({"train/loss": float(step), "only": 1.0 * step}, step)
        logger.save()
    return loggers


def test_a_resumed_run_is_one_run_in_every_logger(tmp_path: Path, monkeypatch: Any) -> None:
    """It is killed at step 6, and resumed from a checkpoint of step 4."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "mine" / "seed_0" / "P"
    folder.mkdir(parents=True)
    _log(folder, range(6), "logger=many")
    checkpoint = folder / "last.ckpt"
    torch.save({"global_step": 4}, checkpoint)
    _log(folder, range(4, 8), "logger=many", checkpoint=checkpoint)
    expected = [(step, float(step)) for step in range(8)]
    assert _of_csv(tmp_path)["train/loss"] == expected
    assert _of_tensorboard(tmp_path)[0]["train/loss"] == expected
    assert sorted(set(_of_mlflow(tmp_path)[0]["train/loss"])) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert len(list(tmp_path.rglob("version_*"))) == 1


def test_a_logger_that_is_new_to_a_resumed_run_gets_its_settings(tmp_path: Path) -> None:
    _log(tmp_path, range(4), "logger=tensorboard")
    checkpoint = tmp_path / "last.ckpt"
    torch.save({"global_step": 4}, checkpoint)
    _log(tmp_path, range(4, 6), "logger=csv", checkpoint=checkpoint)
    assert (tmp_path / "csv" / "version_0" / "hparams.yaml").is_file()
    _log(tmp_path, range(4, 6), "logger=csv", checkpoint=checkpoint)
    text = (tmp_path / "csv" / "version_0" / "metrics.csv").read_text()
    rows = csv.DictReader(text.splitlines())
    assert [row["step"] for row in rows] == ["4", "5"]


def test_a_failing_logger_is_named_in_one_line(
    tmp_path: Path, monkeypatch: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """At the start it ends the command; later the training goes on."""
    error = RuntimeError("404 Not Found\nmore")
    mine = f"+logger.mine={{_target_: {__name__}.Refusing, save_dir: null}}"
    monkeypatch.setattr(Refusing, "at_start", error)
    with pytest.raises(SettingError, match=r"logger\.mine: found 404 Not Found; .*~logger\.mine"):
        _log(tmp_path, range(2), "logger=csv", mine)
    monkeypatch.setattr(Refusing, "at_start", None)
    loggers = _log(tmp_path / "again", range(2), "logger=csv", mine)
    assert len(loggers) == 2
    found = capsys.readouterr().err
    assert found.splitlines() == ["logger.mine logs nothing more: 404 Not Found"]


class Refusing(CSVLogger):
    """A logger whose server fails."""

    at_start: Any = None

    def log_hyperparams(self, params: Any = None) -> None:
        if self.at_start is not None:
            raise self.at_start

    def log_metrics(self, *_: Any) -> None:
        raise RuntimeError("404 Not Found\nmore")


def test_the_same_images_are_shown_after_every_validation(
    trained: tuple[Path, PixelTask, Stanford2D3DS],
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
        labels = predict_labels(task, images, (32, 64)).numpy()
        unseen = ~panorama.rgb.any(axis=-1) & (panorama.labels == 0)
        rgb = np.where(unseen[..., None], np.uint8(136), panorama.rgb)
        labels[unseen] = 0
        expected = prediction_panel(rgb, panorama.labels, labels, data.class_names)
        np.testing.assert_array_equal(shown[tag][-1], expected)


def test_figures_of_every_class_are_those_of_numpy(
    trained: tuple[Path, PixelTask, Stanford2D3DS],
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
    trained: tuple[Path, PixelTask, Stanford2D3DS],
) -> None:
    folder, task, data = trained
    total, norm, source = 0.0, 0.0, data.dataset("val")
    head: Any = task.head
    normalization: Any = data.normalization
    for index in range(len(source)):
        panorama, (views,) = source.read(index), TANGENT.view_sets()
        inputs = render_inputs(panorama, views, data.inputs)
        with torch.no_grad():
            scores = task.network(normalize(inputs, normalization, data.inputs)).double()
        labels = views.render(panorama.labels, "nearest").astype(np.int64)
        weights = np.insert(head.class_weights.double().numpy(), 0, 0)[labels]
        chosen = scores.log_softmax(1).gather(1, torch.tensor(labels).clamp(min=1)[:, None] - 1)
        total -= float((chosen[:, 0].numpy() * weights).sum())
        norm += float(weights.sum())
    assert _of_csv(folder)["val/loss"][-1][1] == pytest.approx(total / norm, rel=1e-5)
