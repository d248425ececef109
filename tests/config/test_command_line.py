"""Words of a command line: interpolations, names of other programs, hints, and the version."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import tangent_train
from tangent_train.cli import main, processes
from tests.cli.tiny_runs import run_command
from tests.config.test_settings import GIVEN
from tests.running import Capture, Patch, composed_settings, run_python

UNREAD = "expected no such setting: tangent-evaluate does not read it."


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MY_DATA", str(tmp_path / "my data"))
    monkeypatch.delenv("UNSET", raising=False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train ckpt_path=x", "ckpt_path: found x; .*Did you mean resume or init_from?"),
        ("transfer ckpt_path=x", "Did you mean checkpoint?"),
        ("train batch_size=2", "Did you mean data.batch_size?"),
        ("predict data.batch_size=2 input=x", "Did you mean view_batch_size?"),
        ("train trainer.epochs=2", "Did you mean trainer.max_epochs?"),
        ("evaluate optimizer.learning_rate=2", UNREAD),
        ("train model=unet", "Did you mean network?"),
        ("predict +level=5", "Did you mean levels?"),
        ("train save_dir=x", "Did you mean hydra.run.dir?"),
        ("train --checkpoint x", "--checkpoint: found an option; .*mean resume or init_from?"),
        ("train --config x.yaml", "Did you mean experiment?"),
        ("predict net.onnx in out", "mean checkpoint=net.onnx input=in output=out?"),
        ("predict checkpoint=net.onnx in", "Did you mean input=in?"),
        ("render a(1).jpg", "Did you mean 'input=\"a(1).jpg\"'?"),
        ("predict -c net.ckpt -i a.jpg", "-c: found an invalid choice: 'net.ckpt' "),
        ("train n_gpu=1", "Did you mean trainer.devices?"),
        ("train patience=3", "Did you mean callbacks?"),
        ("import url=x", "Did you mean model?"),
        ("import path=x", "Did you mean file or model?"),
        ("render heading=x", "Did you mean yaw?"),
        ("export input_size=8", "Did you mean image_size?"),
        ("check input=x", "Did you mean data.root?"),
        ("train inputs=[rgb]", "Did you mean data.inputs?"),
        ("predict inputs=x", "Did you mean input?"),
        ("train fast", "fast: found a word without =; .*tangent-train --help lists them."),
        ("train experiment=rooms/demoo", "experiment: found rooms/demoo; .*mean rooms/demo?"),
        ("train recipe=small recipe/task=small_mine", "recipe/task: found small_mine; "),
        (
            "check data=folder data.root=no",
            "found no, no such folder; expected a folder with classes",
        ),
        ("transfer experiment=rooms/transfer label_map=no.json", "label_map: found no.json; "),
        ("predict input=. output=a checkpoint=. rotations=361", "less than or equal to 360."),
        ("render", "Missing: output=. Example: tangent-render input=panoramas output=tangent"),
        ("train data=5", "data: found 5; expected one of cityscapes, densepass, "),
        (
            "train debug=true",
            "debug: found true; expected one of fast, limit, overfit, profile, or ~debug.",
        ),
        ("train -m debug=true,false", "debug: found true,false; expected one of fast, limit, "),
        ("train network=[1]", "network: found [1]; expected one of deeplabv3_mobilenet, "),
        ("predict debug=true", "debug: found a value; .*tangent-predict does not read it."),
        ("predict representation=erp", "tangent-predict does not read it. Did you mean views?"),
        ("evaluate recipe=true", UNREAD),
        ("check callbacks=null", "callbacks: found null; .*, or ~callbacks."),
        ("keypoints a.jpg b.jpg", "mean left=a.jpg right=b.jpg?"),
        ("keypoints holiday out", "mean input=holiday output=out?"),
        ("import net.onnx net.ckpt", "mean file=net.onnx output=net.ckpt?"),
        ("import nvidia/b0 output=x", "mean model=nvidia/b0?"),
        ("train launcher=slurm", "launcher: found a value; expected a sweep: tangent-train -m "),
        ("evaluate checkpoint=. sweep=folds", "sweep: found a value; .*tangent-evaluate -m "),
        ("train data.root=~/x", f"in full: data.root={Path('~/x').expanduser()}"),
        ("train data.root=r(a", "Quote other characters: 'data.root=\"r(a\"'"),
        ("train data.root=${oc.env:UNSET}", "data.root: found .*'UNSET' not found; expected"),
        ("train data.root=${rot}", "data.root: found Interpolation key 'rot' not found; "),
        ("train resume=${oc.env:UNSET}", "resume: found .*'UNSET' not found; expected"),
        ("train resume=${oc.env:MY_DATA}", "my data: found no config.yaml"),
    ],
)
def test_hints_are_true_for_the_command(
    words: str, message: str, monkeypatch: Patch, capsys: Capture
) -> None:
    command, *arguments = words.split()
    expected = ".*".join(map(re.escape, message.split(".*")))
    with pytest.raises(SystemExit, match=expected) as ended:
        run_command(monkeypatch, command, *arguments)
    text = str(ended.value)
    assert "\n" not in text
    assert ("mean " in message) == ("Did you mean" in text)
    assert not any(capsys.readouterr())


def test_interpolations_are_those_of_files(tmp_path: Path) -> None:
    root = "${oc.env:MY_DATA}/${name}"
    settings = composed_settings("train", f"data.root={root}", f"data.cache='{root}'", "name=x")
    assert settings.data["root"] == settings.data["cache"] == f"{tmp_path}/my data/x"
    given = GIVEN["predict"]
    assert composed_settings("predict", *given, "input=${oc.env:MY_DATA}").input == str(
        tmp_path / "my data"
    )


def test_jobs_of_a_sweep_resolve_interpolations(tmp_path: Path, monkeypatch: Patch) -> None:
    lines: list[list[str]] = []

    def run_process(line: list[str]) -> int:
        lines.append(line)
        return 0

    monkeypatch.setattr(processes, "run_process", run_process)
    root = "data.root=${oc.env:MY_DATA}/${name}"
    run_command(monkeypatch, "train", "-m", "seed=1,2", root, "hydra.sweep.dir=sweep")
    found = [composed_settings("train", *line[1:3]) for line in lines]
    expected = f"{tmp_path}/my data/run"
    assert [(one.seed, one.data["root"]) for one in found] == [(1, expected), (2, expected)]


@pytest.mark.parametrize(
    "setting",
    [
        *("trainer.max_epochs=1", "task.head.label_smoothing=0.1", "data.color_jitter=1"),
    ],
)
def test_an_evaluation_refuses_settings_of_a_training(setting: str, monkeypatch: Patch) -> None:
    with pytest.raises(
        SystemExit, match=f"{setting.partition('=')[0]}: found a value; {re.escape(UNREAD)}"
    ):
        run_command(monkeypatch, "evaluate", "checkpoint=.", "data=synthrooms", setting)


def test_a_command_prints_the_version(monkeypatch: Patch, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        run_command(monkeypatch, "train", "--version")
    assert not ended.value.code
    expected = version("tangent-train")
    assert capsys.readouterr().out == f"tangent-train {expected}\n"
    assert tangent_train.__version__ == expected


def test_the_package_lists_its_commands(monkeypatch: Patch, capsys: Capture) -> None:
    monkeypatch.setattr(sys, "argv", ["tangent_train"])
    main.overview()
    printed = capsys.readouterr().out
    commands = {line.split()[0] for line in printed.splitlines() if line.startswith("tangent-")}
    scripts = Path(tangent_train.__file__).parents[1] / "pyproject.toml"
    assert commands == {
        line.split()[0] for line in scripts.read_text().splitlines() if "cli.main:" in line
    }


def test_modules_run_as_commands(tmp_path: Path) -> None:
    done = run_python(tmp_path, "-m", "tangent_train.cli.export", "output=x.onnx")
    assert done.returncode == 1
    example = "tangent-export checkpoint=<run>/checkpoints/best.ckpt output=model.onnx"
    assert done.stderr == f"tangent-export: Missing: checkpoint=. Example: {example}\n"


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        ("predict", "checkpoint=, input=, output="),
        ("train", "data= or experiment="),
        ("train -m seed=1,2", "data= or experiment="),
    ],
)
def test_missing_settings_are_named_together_with_an_example(
    words: str, missing: str, monkeypatch: Patch, tmp_path: Path
) -> None:
    command, *arguments = words.split()
    expected = f"^tangent-{command}: Missing: {missing}. Example: tangent-{command} [^\n]*=[^\n]*$"
    with pytest.raises(SystemExit, match=expected):
        run_command(monkeypatch, command, *arguments)
    assert not [*tmp_path.rglob("rooms")]


@pytest.mark.parametrize("word", ["help", "--hlep", "-help", "--halp"])
def test_words_that_mean_help_print_it(word: str, monkeypatch: Patch, capsys: Capture) -> None:
    run_command(monkeypatch, "export", word)
    assert capsys.readouterr().out.startswith("Write a trained network for other programs")
