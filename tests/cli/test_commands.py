"""The commands end to end on a few tiny made rooms: fit, interrupt, resume, evaluate."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import lightning
import pytest
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from tangent_train.callbacks.checkpoints import LastCheckpoint
from tangent_train.checkpoints.content import read_settings
from tangent_train.cli import main, run
from tangent_train.cli.stored import stored_arguments
from tangent_train.results.record import load_record

AREAS = ("1", "2", "3", "4", "5a", "5b", "6")
SETTINGS = [
    "experiment=rooms/demo",
    "level=4",
    "representation.crop_multiple=null",
    "network.widths=[4,8]",
    "data.panoramas_per_step=2",
    "data.validation_fraction=0.2",
    "data.rooms.height=32",
    *(
        f"data.rooms.rooms.area_{area}={n}"
        for area, n in zip(AREAS, (2, 2, 1, 1, 1, 1, 1), strict=True)
    ),
    "trainer.max_epochs=2",
    "trainer.check_val_every_n_epoch=1",
    "trainer.accelerator=cpu",
    "panels=1",
]


def _run(monkeypatch: pytest.MonkeyPatch, command: str, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [f"tangent-{command}", *arguments])
    getattr(main, command)()


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("rooms") / "made rooms"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        _run(patch, "prepare", *SETTINGS, f"data.root='{folder}'")
    return f"data.root='{folder}'"


@pytest.fixture(scope="module")
def run_folder(rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        _run(patch, "train", *SETTINGS, rooms, "hydra.run.dir=finished")
    return folder / "finished"


def _results(folder: Path) -> dict[str, Any]:
    results: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return results


def test_a_run_leaves_everything_in_its_folder(run_folder: Path) -> None:
    results = _results(run_folder)
    assert results["images"] == 2
    assert len(results["classes"]) == 13
    assert (run_folder / "results.md").read_text().count("\n") > 20
    assert (run_folder / "results.csv").is_file()
    assert list((run_folder / "tensorboard").glob("events.*"))
    assert (run_folder / "config.yaml").is_file()
    (panel,) = (run_folder / "panels").glob("*.png")
    picture = cv2.imread(str(panel))
    assert picture is not None
    assert picture.shape[1] == 2 * 512 + 8
    page = (run_folder / "report.html").read_text()
    assert all(f"<h2>{title}</h2>" in page for title in ("Per class", "Confusion"))
    assert page.count('<li><button type="button"><img') == 1


def test_checkpoints_hold_tensors_and_plain_values_only(run_folder: Path) -> None:
    for name in ("best", "last"):
        path = run_folder / "checkpoints" / f"{name}.ckpt"
        content = torch.load(path, weights_only=True)
        assert content["config"]["level"] == 4
        assert content["config"]["data"]["rooms"]["height"] == 32


def test_evaluating_the_checkpoint_repeats_the_numbers_exactly(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    _run(monkeypatch, "evaluate", f"checkpoint={checkpoint}", rooms, "hydra.run.dir=again")
    assert _results(tmp_path / "again") == _results(run_folder)
    again, before = (load_record(folder).settings for folder in (tmp_path / "again", run_folder))
    differing = {n for n in again.keys() | before.keys() if again.get(n) != before.get(n)}
    # And what was evaluated can be read with its figures; on which processor is said anew.
    assert differing == {"checkpoint", "trainer.accelerator"}


def test_an_evaluation_says_which_data_it_cannot_find(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    with pytest.raises(
        SystemExit, match=r"data\.root: found no folder.* had data\.root='.*made rooms'"
    ):
        _run(monkeypatch, "evaluate", f"checkpoint={checkpoint}", "hydra.run.dir=again")
    assert not (tmp_path / "data").exists()


def test_overrides_apply_to_the_checkpoints_config(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    arguments = [f"checkpoint={checkpoint}", rooms, "data.test_rotation=so3"]
    _run(monkeypatch, "evaluate", *arguments, "hydra.run.dir=turned")
    assert _results(tmp_path / "turned")["confusion"] != _results(run_folder)["confusion"]
    with pytest.raises(SystemExit, match=r"Did you mean data\.test_rotation"):
        _run(monkeypatch, "evaluate", *arguments[:2], "data.test_rotatio=so3")


def test_an_interrupted_run_says_how_to_go_on_and_ends_the_same(
    run_folder: Path,
    rooms: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    original = LastCheckpoint.on_train_epoch_end

    def interrupt(self: LastCheckpoint, trainer: Any, task: Any) -> None:
        original(self, trainer, task)
        if trainer.current_epoch == 0:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(LastCheckpoint, "on_train_epoch_end", interrupt)
        with pytest.raises(SystemExit):
            _run(patch, "train", *SETTINGS, rooms, "hydra.run.dir=cut")
    command = capsys.readouterr().err.strip().splitlines()[-1]
    begun, resume, *typed = shlex.split(command)
    assert (begun, resume) == ("tangent-train", f"resume={tmp_path / 'cut'}")
    assert sorted(typed) == sorted([rooms, *(s for s in SETTINGS if s.startswith("trainer.acc"))])
    _run(monkeypatch, "train", *shlex.split(command)[1:])
    assert _results(tmp_path / "cut") == _results(run_folder)


def test_a_run_starts_from_the_network_of_another(
    run_folder: Path,
    rooms: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    rgb = ["data.inputs=[rgb]", "trainer.max_epochs=1", "hydra.run.dir=begun"]
    _run(monkeypatch, "train", *SETTINGS, rooms, *rgb, f"init_from={checkpoint}")
    table = capsys.readouterr().out
    assert "left out: depth" in table
    assert re.search(r"fresh +│ +0 ", table)
    assert _results(tmp_path / "begun")["images"] == 2
    foreign = tmp_path / "foreign.pt"
    torch.save({"x": torch.zeros(1)}, foreign)
    with pytest.raises(SystemExit, match=r"foreign\.pt: found no tensor that fits, but x"):
        _run(monkeypatch, "train", *SETTINGS, rooms, f"init_from={foreign}")


def test_further_inputs_start_at_zero_and_stay_in_the_checkpoint(
    run_folder: Path,
    rooms: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Attention, elevation and averaged weights on top of a plain network, then an evaluation."""
    monkeypatch.chdir(tmp_path)
    further = [
        "data.inputs=[rgb,depth,elevation]",
        "network=unet_small_context",
        "network.stage=network.downs.0",
        "network.network.stage=downs.0",
        "network.network.network.widths=[4,8]",
        "representation.average_rotations=2",
        "ema=0.9",
        "trainer.max_epochs=1",
        "hydra.run.dir=begun",
    ]
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    settings = [text for text in SETTINGS if not text.startswith("network.")]
    _run(monkeypatch, "train", *settings, rooms, *further, f"init_from={checkpoint}")
    assert "stem.weight: starts at zero: elevation" in capsys.readouterr().out
    best = tmp_path / "begun/checkpoints/best.ckpt"
    content = torch.load(best, weights_only=True)
    assert content["inputs"] == ["rgb", "depth", "elevation"]
    again = [f"checkpoint={best}", rooms, "hydra.run.dir=again"]
    _run(monkeypatch, "evaluate", *again)
    figures = [_results(tmp_path / folder)["confusion"] for folder in ("begun", "again")]
    assert figures[0] == figures[1]
    with pytest.raises(SystemExit, match=r"found inputs \['rgb', 'depth'\]"):
        _run(monkeypatch, "evaluate", *again, "data.inputs=[rgb,depth]", "hydra.run.dir=other")


def test_settings_of_the_checkpoint_reach_what_refers_to_them(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    odd = tmp_path / "a=b (1)" / "x.ckpt"
    odd.parent.mkdir()
    odd.write_bytes((run_folder / "checkpoints" / "best.ckpt").read_bytes())
    arguments = [f"checkpoint={odd}", rooms, "data.test_rotation=so3"]
    for seed in (1, 2):
        _run(monkeypatch, "evaluate", *arguments, f"seed={seed}", f"hydra.run.dir={seed}")
    first, second = (_results(tmp_path / str(seed))["confusion"] for seed in (1, 2))
    assert first != second, "the seed of the test rotations"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("network=unet", "expected overrides of single settings"),
        ("representation=erb", "unknown representation: .*Did you mean erp"),
        ("trainer=dpp", "unknown trainer: .*Did you mean ddp"),
        ("data.inputs=[rgb]", "found inputs .* which the network was trained with"),
        ("data=omnisynthia", r"found class names .*'sky'.*; expected .*'beam'"),
    ],
)
def test_what_a_checkpoint_cannot_do_is_refused(
    run_folder: Path,
    rooms: str,
    override: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = run_folder / "checkpoints" / "best.ckpt"
    with pytest.raises(SystemExit, match=message):
        _run(monkeypatch, "evaluate", f"checkpoint={checkpoint}", rooms, override)


def test_several_options_of_a_group_are_a_sweep(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}", rooms]
    with pytest.raises(SystemExit, match="To sweep over it, add --multirun"):
        _run(monkeypatch, "evaluate", *arguments, "representation=tangent,erp")
    with pytest.raises(SystemExit, match=r"unknown representation: found 'erb'; .*mean erp"):
        _run(monkeypatch, "evaluate", "-m", *arguments, "representation=tangent,erb")


def test_a_checkpoint_is_evaluated_on_other_data_through_another_representation(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    checkpoint = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    same_rooms = [text for text in SETTINGS if text.startswith("data.rooms.")]
    chosen = ["data=synthrooms", rooms, *same_rooms, "representation=erp"]
    _run(monkeypatch, "evaluate", checkpoint, *chosen, "hydra.run.dir=other")
    config = read_settings(tmp_path / "other" / "config.yaml")
    assert config["data"]["panoramas_per_step"] == 4, "the option's own, not the run's"
    assert "base_level" not in config["representation"]
    assert config["representation"]["level"] == 4
    assert _results(tmp_path / "other")["confusion"] != _results(run_folder)["confusion"]


def test_evaluation_on_other_data_keeps_fold_and_inputs(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "fold_2.ckpt"
    content = torch.load(run_folder / "checkpoints" / "best.ckpt", weights_only=True)
    content["config"]["data"] |= {"fold": 2, "inputs": ["rgb"]}
    torch.save(content, path)
    chosen = ["data=synthrooms", rooms, "hydra.run.dir=other"]
    with monkeypatch.context() as patch:
        found: list[dict[str, Any]] = []
        patch.setattr(run, "evaluate", lambda settings, trust: found.append(settings))
        _run(patch, "evaluate", f"checkpoint={path}", *chosen)
        _run(patch, "evaluate", f"checkpoint={path}", *chosen, "data.fold=3", "data.inputs=[depth]")
    assert found[0]["data"]["fold"] == 2, "the network has seen the rooms of the others"
    assert found[0]["data"]["inputs"] == ["rgb"], "it takes no others"
    assert found[1]["data"]["fold"] == 3, "but what is typed counts"
    assert found[1]["data"]["inputs"] == ["depth"]


def test_processes_of_a_run_go_on_with_the_same_stored_run() -> None:
    typed = ["checkpoint=x.ckpt", "representation=erp", "data.test_rotation=0,45"]
    assert stored_arguments("evaluate", typed) == typed[:1]
    assert stored_arguments("train", ["resume=x", "seed=1"]) == ["resume=x"]
    assert stored_arguments("prepare", typed) == []


def test_a_schedule_cannot_be_resumed_with_another_length(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run_folder, copy)
    with pytest.raises(SystemExit, match=r"trainer\.max_epochs, .*: found .* steps of training"):
        _run(monkeypatch, "train", f"resume={copy}", rooms, "trainer.max_epochs=3")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["representation.faces_per_panorama=99"], "representation.faces_per_panorama: found 99"),
        (["network=unet"], "image size for the UNet: found 48×48"),
        (["network.num_classes=5"], "scores of the network"),
        (["data.fold=4"], "data.fold: found 4"),
    ],
)
def test_impossible_settings_are_refused_before_any_data_is_made(
    overrides: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=rf"^tangent-train: {message}"):
        _run(monkeypatch, "train", "experiment=rooms/demo", *overrides)
    assert not (tmp_path / "data").exists()


def test_a_missing_data_set_is_an_error_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"tangent-train: .*nowhere"):
        _run(monkeypatch, "train", "data=stanford2d3ds", "data.root=nowhere")


def test_evaluate_needs_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="checkpoint: found none"):
        _run(monkeypatch, "evaluate")


@pytest.mark.parametrize(
    ("command", "example"), [("train", "rooms/demo"), ("transfer", "rooms/transfer")]
)
def test_help_answers_before_anything_heavy_is_imported(
    command: str, example: str, tmp_path: Path
) -> None:
    code = (
        f"import sys; from tangent_train.cli.main import {command}\n"
        f"sys.argv = ['tangent-{command}', '--help']\n"
        f"{command}()\n"
        "assert not {'torch', 'lightning', 'cv2', 'numba'} & set(sys.modules), 'heavy import'"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert f"tangent-{command} experiment={example}" in done.stdout


def test_what_lightning_refuses_is_said_in_one_line(
    run_folder: Path, rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it does when a run of six epochs is resumed for three."""
    again = tmp_path / "again"
    shutil.copytree(run_folder, again)

    def refuse(*_: Any, **__: Any) -> None:
        raise MisconfigurationException("You restored a checkpoint with current_epoch=6")

    monkeypatch.setattr(lightning.Trainer, "fit", refuse)
    with pytest.raises(SystemExit, match=r"tangent-train: trainer: found .*current_epoch=6"):
        _run(monkeypatch, "train", f"resume={again}", rooms)
