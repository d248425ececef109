"""``task=depth`` through the commands: training to prediction, sweeps and transfers."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch

from tangent_train.checkpoints.loaded import load_network
from tests.cli.tiny_runs import SMALL_ROOMS, Run, results, run_in
from tests.inference.trained import write_depth_checkpoint

SETTINGS = (
    "experiment=rooms/depth",
    *SMALL_ROOMS,
    "data.root='../small rooms'",
    "data.rooms.views_per_camera=2",
    "data.rooms.view_size=32",
    "data.val_fraction=0.4",
    "network.widths=[4,8]",
    "trainer.check_val_every_n_epoch=1",
    "panels=1",
    "logger=csv",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run of three epochs, with a moving average of its weights."""
    folder = tmp_path_factory.mktemp("depth") / "here"
    folder.mkdir()
    more = ("ema=0.5", "callbacks=early_stopping", "trainer.max_epochs=3")
    run_in(folder, "train", *SETTINGS, *more, "hydra.run.dir=whole")
    return folder


@pytest.fixture
def run(folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in the folder of the finished run."""
    monkeypatch.chdir(folder)
    return run


def _logged(path: Path) -> dict[int, float]:
    (file,) = path.rglob("metrics.csv")
    with file.open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row["val/absrel"]]
    return {int(row["epoch"]): float(row["val/absrel"]) for row in rows}


def test_the_best_epoch_has_the_smallest_error_and_is_reported(folder: Path, run: Run) -> None:
    scores = _logged(folder / "whole")
    best = torch.load(folder / "whole" / "checkpoints" / "best.ckpt", weights_only=True)
    assert len(scores) == 3
    assert scores[best["epoch"]] == min(scores.values()) < max(scores.values())
    content = results(folder / "whole")
    assert content["protocol"]["alignment"] == "none"
    assert content["protocol"]["range"] == "0 to ∞ m"
    assert len(content["latitude_bands"]) == 6
    assert content["columns"]["absrel"]["better"] == "lower"
    low, high = content["intervals"]["absrel"]
    assert low <= content["scores"]["absrel"] <= high
    assert "AbsRel" in (folder / "whole" / "report.html").read_text()
    assert len(list((folder / "whole" / "panels").iterdir())) == 1
    run("report", "whole")
    with Path("report/report.csv").open(newline="") as file:
        means = {r["score"]: float(r["mean"]) for r in csv.DictReader(file) if r["fold"] == "1"}
    assert means.keys() >= {"absrel", "delta1", "mae", "absrel_solid_angle"}


def test_evaluation_takes_other_alignments_and_limits(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = [text for text in SETTINGS if text.startswith(("data", "experiment", "task", "level"))]
    checkpoint = ["checkpoint=whole/checkpoints/best.ckpt", *kept]
    run("evaluate", *checkpoint, "hydra.run.dir=again")
    assert results(Path("again")) == results(Path("whole"))
    limits = (
        "task.head.alignment=affine",
        "task.head.max_distance=3",
        "task.head.clip=true",
        "task.head.align=none",
    )
    run("evaluate", *checkpoint, *limits, "hydra.run.dir=aligned")
    content = results(Path("aligned"))
    assert content["protocol"]["alignment"] == "affine in distance"
    assert content["protocol"]["range"] == "0 to 3 m, predictions clipped"
    assert content["scores"]["rmse"] < results(Path("whole"))["scores"]["rmse"]
    facts = (
        "alignment: affine in distance; range: 0 to 3 m, predictions clipped; views aligned: none"
    )
    printed = capsys.readouterr().out
    pages = [Path("aligned", name).read_text() for name in ("results.md", "report.html")]
    assert all(facts in " ".join(text.split()) for text in (printed, *pages))


def test_a_resumed_run_is_the_same(run: Run) -> None:
    """Stopped after the first epoch, by the limit of a setting that may change."""
    plain = (*SETTINGS, "scheduler=constant", "panels=0")
    run("train", *plain, "trainer.max_epochs=2", "hydra.run.dir=two")
    run("train", *plain, "trainer.max_epochs=1", "hydra.run.dir=one")
    run("train", "resume=one", "trainer.max_epochs=2")
    files = [Path(name, "checkpoints", "last.ckpt") for name in ("one", "two")]
    tensors = [torch.load(file, weights_only=True)["state_dict"] for file in files]
    for name, tensor in tensors[0].items():
        assert tensor.equal(tensors[1][name]), name
    assert results(Path("one"))["scores"] == results(Path("two"))["scores"]


def test_fine_tuning_starts_from_a_run_and_keeps_the_kind_of_an_imported_network(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    once = (*SETTINGS[:-2], "panels=0", "logger=none", "trainer.max_epochs=1")
    run("train", *once, "init_from=whole/checkpoints/best.ckpt", "hydra.run.dir=tuned")
    assert load_network(Path("tuned/checkpoints/last.ckpt")).depth_kind == "log_distance"

    write_depth_checkpoint(Path("photos.ckpt"), depth_kind="relative_disparity")
    tuned = [s for s in once if "widths" not in s] + ["init_from=photos.ckpt"]
    with pytest.raises(SystemExit, match=r"task\.head\.alignment.*relative_disparity"):
        run("train", *tuned, "hydra.run.dir=refused")
    run("train", *tuned, "task.head.alignment=affine", "hydra.run.dir=relative")
    assert "Output of the network: relative_disparity" in capsys.readouterr().out
    trained = load_network(Path("relative/checkpoints/best.ckpt"))
    assert trained.depth_kind == "relative_disparity"
    assert results(Path("relative"))["protocol"]["alignment"] == "affine in disparity"


@pytest.mark.usefixtures("stages")
def test_a_transfer_compares_views_and_their_alignment(run: Run) -> None:
    shown = ("compare=[{name: unaligned, task.head.align: none}, erp]", "fine_tuning.epochs=[1]")
    more: tuple[str, ...] = (*shown, "trainer.max_epochs=1", "photos.representation.dim=16")
    given = [s.replace("rooms/depth", "rooms/transfer_depth") for s in SETTINGS]
    run("transfer", *given, *more, "photos.data.batch_size=4", "name=mine", "panels=0")
    stages: dict[str, Any] = {}
    for path in Path("runs/transfer/mine").rglob("results.json"):
        stages[path.parent.name] = results(path.parent)
    assert stages.keys() == {"P", "S", "S-unaligned", "S-erp", "P-FT-1", "S-FT-1"}
    assert stages["S"]["scores"]["absrel"] != stages["S-unaligned"]["scores"]["absrel"]
    assert stages["P"]["scores"]["absrel_solid_angle"] is None
    text = Path("runs/transfer/mine/transfer.md").read_text()
    assert "AbsRel ↓" in text
    assert "S-unaligned" in text
    assert torch.isfinite(torch.tensor([s["scores"]["absrel"] for s in stages.values()])).all()
