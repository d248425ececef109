"""Words of a command line: interpolations, names of other programs, hints, and the version."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import pytest

import tangent_train
from tangent_train.cli import processes
from tests.cli.tiny_runs import run_command
from tests.config.test_settings import GIVEN
from tests.running import Capture, Patch, composed_settings

UNREAD = "expected no such setting: tangent-evaluate does not read it."


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MY_DATA", str(tmp_path / "my data"))
    monkeypatch.delenv("UNSET", raising=False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train data.batchsize=2", "Did you mean data.batch_size?"),
        ("train trainer.epochs=2", "Did you mean trainer.max_epochs?"),
        ("predict +level=5", "Did you mean levels?"),
        ("predict net.onnx in out", "net.onnx: found text that Hydra cannot read; expected sett"),
        ("train fast", "fast: found text that Hydra cannot read; expected settings as name=value"),
        ("train data.root=r(a", "data.root=r(a: found text that Hydra cannot read; "),
        ("train experiment=rooms/demoo", "Could not find 'experiment/rooms/demoo' Available "),
        ("predict input=. output=a checkpoint=. rotations=361", "less than or equal to 360."),
        ("render", "and output=. Example: tangent-render input=panoramas output=tangent"),
        ("train data=5", "Config group override"),
        ("predict representation=erp", "Could not override 'representation'. No match in the "),
        ("evaluate recipe=small", UNREAD),
        ("train launcher=slurm", "launcher: found a value; expected a sweep: tangent-train -m "),
        ("evaluate checkpoint=. sweep=folds", "sweep: found a value; .*tangent-evaluate -m "),
        ("train data=synthrooms data.root=${oc.env:UNSET}", "'UNSET' not found"),
        ("train data=synthrooms data.root=${rot}", "Interpolation key 'rot' not found"),
        ("train resume=${oc.env:UNSET}", "'UNSET' not found"),
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
        *("trainer.max_epochs=1", "task.head.label_smoothing=0.1", "task.backbone_lr_factor=1"),
        *("data.color_jitter=1", "recipe=small", "optimizer.lr=1"),
    ],
)
def test_an_evaluation_refuses_settings_of_a_training(setting: str, monkeypatch: Patch) -> None:
    with pytest.raises(
        SystemExit, match=f"{setting.partition('=')[0]}: found a value; {re.escape(UNREAD)}"
    ):
        run_command(monkeypatch, "evaluate", "checkpoint=.", "data=synthrooms", setting)


@pytest.mark.parametrize("command", ["train", "predict", "report", "import"])
def test_every_command_prints_the_version(
    command: str, monkeypatch: Patch, capsys: Capture
) -> None:
    with pytest.raises(SystemExit) as ended:
        run_command(monkeypatch, command, "--version")
    assert not ended.value.code
    expected = version("tangent-train")
    assert capsys.readouterr().out == f"tangent-{command} {expected}\n"
    assert tangent_train.__version__ == expected


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        ("predict", "checkpoint=, input=, output="),
        ("predict output=x rotations=0", "checkpoint=, input="),
        ("keypoints", "output="),
        ("train", "data= or experiment="),
        ("train -m seed=1,2", "data= or experiment="),
        ("evaluate level=5", "data= or experiment="),
        ("transfer", "data= or experiment="),
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
