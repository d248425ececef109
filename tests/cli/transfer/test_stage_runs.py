"""What is in the folders of stages, and which of it is refused."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

from tangent_train.cli.transfer import stage_runs
from tangent_train.cli.transfer.stage_runs import run_stage, said_as_a_command, stage_state
from tangent_train.cli.transfer.stages import Stage
from tangent_train.errors import DataError, SettingError
from tests.cli.transfer.pretended_runs import OF_SEED_0, PretendedRuns, run_transfer


def test_a_folder_of_other_settings_is_refused(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_transfer(monkeypatch, "compare=[]", "fine_tuning.epochs=[]")
    before = len(runs.started)
    for override, message in {
        "optimizer.lr=1": r"seed_0/P: found stage P with optimizer\.lr=0\.003 \(now 1\), sch",
        "representation.blend=feather": r"/S: found stage S with representation\.blend='nearest'",
        "task.absent_class=zero": r"stage P with task\.absent_class='skip' \(now 'zero'",
        "trainer.max_epochs=3": r"with trainer\.max_epochs=20 \(now 3\); .* another name=",
        "data.rooms.seed=1": r"found stage P with data\.rooms\.seed=0 \(now 1\)",
    }.items():
        with pytest.raises(SystemExit, match=rf"^tangent-transfer: .*{message}"):
            run_transfer(monkeypatch, override)
    assert len(runs.started) == before, "said before anything is run"


def test_a_foreign_folder_is_refused(runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch) -> None:
    (OF_SEED_0 / "S-FT-1").mkdir(parents=True)
    (OF_SEED_0 / "S-FT-1" / "thesis.tex").touch()
    with pytest.raises(SystemExit, match="S-FT-1: found files that tangent-transfer did not write"):
        run_transfer(monkeypatch)
    assert not runs.started


def test_stages_of_a_network_that_was_trained_again_are_refused(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = ("compare=[]", "fine_tuning.epochs=[]")
    run_transfer(monkeypatch, *short)
    network = OF_SEED_0 / "P" / "checkpoints" / "last.ckpt"
    network.write_text("another network, longer")
    with pytest.raises(SystemExit, match=r"seed_0/S: found stage S of another network; expected"):
        run_transfer(monkeypatch, *short)
    network.unlink()  # to save space: what was found stays found
    run_transfer(monkeypatch, *short)
    with pytest.raises(SystemExit, match=r"seed_0/P: found no checkpoints/best\.ckpt or last"):
        run_transfer(monkeypatch, "compare=[erp]", "fine_tuning.epochs=[]")


def test_a_moved_transfer_goes_on(runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch) -> None:
    runs.failing = "S-FT-1"
    with pytest.raises(SystemExit):
        run_transfer(monkeypatch, "compare=[]")
    shutil.move("runs", "elsewhere")
    runs.failing, runs.started = None, []
    run_transfer(monkeypatch, "compare=[]", "hydra.run.dir=elsewhere/transfer/mine")
    assert runs.started == [("train", "S-FT-1")]
    assert "/elsewhere/" in runs.configs[-1].resume
    assert runs.configs[-1].init_from is None, "its own checkpoint has the tensors"


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    config = {
        "name": "a",
        "seed": 0,
        "data": {"root": "my rooms"},
        "trainer": {"max_epochs": 2, "devices": 1},
        "representation": {},
    }
    return Stage(
        name="P",
        on="photos",
        fold=None,
        seed=0,
        folder=tmp_path / "it's = a (stage)",
        command="train",
        config=config,
        weights=None,
    )


def test_any_folder_can_be_named(stage: Stage, runs: PretendedRuns) -> None:
    assert stage_state(stage) == "new"
    assert run_stage(stage, "new") == 0
    assert stage_state(stage) == "finished"
    words = shlex.split(said_as_a_command(stage, "new"))
    assert words[:3] == ["tangent-train", f"--config-dir={stage.folder}", "--config-name=stage"]
    again = shlex.split(said_as_a_command(stage, "begun"))
    assert again == ["tangent-train", f"resume={stage.folder}", "data.root=my rooms"]


def test_an_interrupted_start_is_none(stage: Stage) -> None:
    stage.folder.mkdir()
    (stage.folder / ".partial-x.json").touch()
    assert stage_state(stage) == "new"
    (stage.folder / "stage.json").write_text('{"stage": "P", "weights": null}')
    assert stage_state(stage) == "new"


@pytest.mark.parametrize("text", ["a: [", "[1]", '{"stage": "P", "weights": null, "settings": 1}'])
def test_a_broken_file_is_named(text: str, stage: Stage, runs: PretendedRuns) -> None:
    run_stage(stage, "new")
    (stage.folder / "stage.json").write_text(text)
    with pytest.raises(DataError, match=r"stage\.json: found .*delete the folder"):
        stage_state(stage)


def test_its_config_is_written_and_never_read(stage: Stage, runs: PretendedRuns) -> None:
    run_stage(stage, "new")
    (stage.folder / "stage.yaml").write_text("a: [")
    assert stage_state(stage) == "finished"


def test_a_killed_process_has_the_status_of_a_shell(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage_runs, "run_process", lambda *_: (-9, []))
    assert run_stage(stage, "new") == 137


def test_evaluations_do_not_depend_on_how_training_goes(stage: Stage, runs: PretendedRuns) -> None:
    evaluation = replace(stage, command="evaluate")
    run_stage(evaluation, "new")
    longer = {**stage.config, "trainer": {"max_epochs": 9, "devices": 4}, "optimizer": {"lr": 1}}
    assert stage_state(replace(evaluation, config=longer)) == "finished"
    shutil.rmtree(stage.folder)
    run_stage(stage, "new")
    with pytest.raises(
        SettingError, match=r"lr=None \(now 1\), trainer\.devices=1 \(now 4\), trainer\.max_epochs"
    ):
        stage_state(replace(stage, config=longer))


def test_two_commands_never_run_the_same_stage(stage: Stage, runs: PretendedRuns) -> None:
    stage.folder.mkdir(parents=True, exist_ok=True)
    with FileLock(stage.folder / ".lock"):
        with pytest.raises(SettingError, match="another tangent-transfer that runs stage P"):
            run_stage(stage, "new")
        assert not runs.started
        assert stage_state(stage) == "new"
    assert run_stage(stage, "new") == 0
