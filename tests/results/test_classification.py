"""What a classification leaves: files, table, pictures, page."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import (  # type: ignore[import-untyped]
    EventAccumulator,
)

from tangent_train.callbacks.results import evaluated, pictures, write_evaluation
from tangent_train.callbacks.tensorboard import TrainingSpeed, ValidationConfusion
from tangent_train.results.classification import (
    classification_results,
    classification_table,
    write_classification_results,
)
from tangent_train.results.confusion_picture import confusion_picture
from tangent_train.results.html.classification import write_classification_report
from tests.tasks.shapes import Shapes, quiet_trainer, shape_task

NAMES = ("bottle", "chair [old]", "mug", "plant")
MATRIX = np.array([[6, 1, 1, 0], [0, 4, 0, 0], [3, 0, 1, 0], [0, 0, 0, 0]])


def _results() -> dict[str, Any]:
    return classification_results(MATRIX, NAMES, "shapes")


def test_results_are_plain_and_complete(tmp_path: Path) -> None:
    results = _results()
    write_classification_results(results, tmp_path)
    assert json.loads((tmp_path / "results.json").read_text()) == results
    assert results["kind"] == "classification"
    assert (results["images"], results["noun"]) == (16, "shapes")
    assert results["accuracy"] == 11 / 16
    assert results["class_accuracy"] == pytest.approx((6 / 8 + 1 + 1 / 4) / 3)
    assert results["confusion"] == MATRIX.tolist()
    assert [tuple(entry.values()) for entry in results["classes"]] == [
        ("bottle", 8, 0.75, "chair [old]", 0.125),  # of equals the first
        ("chair [old]", 4, 1.0, None, None),
        ("mug", 4, 0.25, "bottle", 0.75),
        ("plant", 0, None, None, None),
    ]


def test_csv_and_markdown_hold_the_same_figures(tmp_path: Path) -> None:
    write_classification_results(_results(), tmp_path)
    with (tmp_path / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["class"] for row in rows] == list(NAMES)
    assert (rows[2]["accuracy"], rows[2]["taken_for"]) == ("0.25", "bottle")
    text = (tmp_path / "results.md").read_text()
    assert text.startswith("# Results over 16 shapes\n\n| class | shapes | accuracy % |")
    assert "| mug | 4 | 25.0 | bottle | 75.0 |" in text
    assert "| plant | 0 | – | – | – |" in text
    assert "| mean of the classes |  | 66.7 |  |  |" in text
    assert text.endswith("| all shapes | 16 | 68.8 |  |  |\n")


def test_the_table_shows_every_class_and_the_means() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(classification_table(_results()))
    text = console.export_text()
    for word in ("16 shapes", "chair [old]", "most often taken for", "25.0", "66.7", "68.8"):
        assert word in text


def test_the_picture_has_every_class(tmp_path: Path) -> None:
    write_classification_results(_results(), tmp_path)
    read = cv2.imread(str(tmp_path / "confusion.png"))
    assert read is not None
    drawn = confusion_picture(MATRIX, NAMES, unknown=False)
    np.testing.assert_array_equal(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), drawn)
    padded = np.pad(MATRIX, ((1, 0), (1, 0)), constant_values=99)
    padded[1:, 0] = 0
    with_unknown = confusion_picture(padded, ("unknown", *NAMES))
    np.testing.assert_array_equal(
        drawn, with_unknown, "the same with an unknown class to leave out"
    )


def test_validations_are_shown_in_tensorboard_and_the_page(tmp_path: Path) -> None:
    logger = TensorBoardLogger(tmp_path, name="", version="tensorboard")
    task = shape_task()
    trainer = quiet_trainer(
        max_epochs=2,
        logger=logger,
        callbacks=[ValidationConfusion(), TrainingSpeed()],
        log_every_n_steps=1,
    )
    trainer.fit(task, datamodule=Shapes())
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    assert [event.step for event in events.Images("val/confusion")] == [2, 5]
    encoded = np.frombuffer(events.Images("val/confusion")[-1].encoded_image_string, np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(
        picture, confusion_picture(task.matrices, task.class_names, unknown=False)
    )
    mean = np.mean([events.Scalars(f"val_accuracy/{n}")[-1].value for n in task.class_names])
    assert mean == pytest.approx(events.Scalars("val/class_accuracy")[-1].value, rel=1e-6)
    assert events.Scalars("val/accuracy")[-1].value == np.float32(task.matrices.trace() / 9)
    assert events.Scalars("speed/images_per_s")[0].value > 0

    checkpoint = tmp_path / "checkpoints" / "best.ckpt"
    write_classification_report(tmp_path / "report.html", _results(), checkpoint)
    page = (tmp_path / "report.html").read_text()
    for title in ("Per class", "Confusion", "Training loss", "Validation"):
        assert f"<h2>{title}</h2>" in page
    assert "accuracy 68.8\u00a0%, mean of the classes 66.7\u00a0% over 16 shapes" in page
    assert "% of the shapes of the row" in page
    assert "mean of the classes</" in page, "the name of a curve"


def test_a_task_writes_its_own(tmp_path: Path) -> None:
    task = shape_task()
    trainer = quiet_trainer()
    trainer.test(task, datamodule=Shapes(), verbose=False)
    results = evaluated(task, "shapes")
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(write_evaluation(task, results, tmp_path / "x.ckpt", tmp_path))
    written = {"results.json", "results.csv", "results.md", "confusion.png", "report.html"}
    assert {path.name for path in tmp_path.iterdir()} == written
    assert "9 shapes" in console.export_text()
    assert [type(c) for c in pictures(task.kind, tmp_path, {})] == [ValidationConfusion]
