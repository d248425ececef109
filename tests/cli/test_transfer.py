"""``tangent-transfer`` from the command line to the tables, with pretended runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from datamodules.core.inputs import RGB_NORMALIZATION
from tangent_train.cli import transfer, transfer_stages
from tangent_train.errors import DataError, SettingError
from tangent_train.results import report
from tests.cli.pretended_runs import HERE, OF_SEED_0, PretendedRuns, run_transfer
from tests.inference.trained import write_checkpoint
from tests.running import Capture, Patch

STAGES = ["P", "S", "S-erp", "S-cubemap", "P-FT-1", "S-FT-1"]
REFUSED = (DataError, SettingError)
SHORT = ("compare=[]", "fine_tuning.epochs=[]")


@pytest.fixture
def runs(monkeypatch: Patch, tmp_path: Path) -> PretendedRuns:
    """In place of the stages of a transfer, in an empty folder."""
    pretended = PretendedRuns()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(transfer_stages, "run_process", pretended)
    # Tested by itself, and slow.
    monkeypatch.setattr(transfer, "_check_data", lambda *_: None)
    monkeypatch.setattr(report, "report_png", lambda *_: b"a picture")
    return pretended


def test_all_stages_run_in_order_and_the_tables_are_written(
    runs: PretendedRuns, capsys: Capture
) -> None:
    run_transfer()
    trained = ("P", "P-FT-1", "S-FT-1")
    assert runs.started == [("train" if s in trained else "evaluate", s) for s in STAGES]
    weights = str(Path(OF_SEED_0 / "P" / "checkpoints" / "best.ckpt").absolute())
    first, *others = runs.configs
    assert first.init_from is None
    for (command, _), config in zip(runs.started[1:], others, strict=True):
        assert config["init_from" if command == "train" else "checkpoint"] == weights
    out = capsys.readouterr().out
    for number, stage in enumerate(STAGES, start=1):
        folder = (OF_SEED_0 / stage).absolute()
        assert f"Stage {number} of 6, {stage} in {folder}: tangent-" in out
        assert f"--config-dir={folder} --config-name=stage hydra.run.dir={folder}" in out
    assert {path.name for path in HERE.glob("transfer.*")} == {
        f"transfer.{suffix}" for suffix in ("md", "csv", "png")
    }
    table = (HERE / "transfer.md").read_text()
    assert "| S-FT-1 | SynthRooms | 1 | 100.0 | +100.0 % | 100.0 | +100.0 % |" in table
    assert "| P | SynthRoomsPerspective | photos | 50.0 | – | 50.0 | – |" in table


def test_finished_stages_are_not_run_again(runs: PretendedRuns, capsys: Capture) -> None:
    run_transfer(*SHORT)
    runs.started.clear()
    capsys.readouterr()
    free = ("panels=9", "trainer.strategy=ddp", "data.root=other", "task.eval_view_batch_size=3")
    run_transfer(*SHORT, *free)
    assert not runs.started
    assert capsys.readouterr().out.count("finished before") == 2
    run_transfer("seeds=[0,1]", "compare=[erp]", "fine_tuning.epochs=[]")
    assert [s for _, s in runs.started] == ["S-erp", "P", "S", "S-erp"]
    assert [config.seed for config in runs.configs[-3:]] == [1] * 3
    listed = (HERE / "transfer.md").read_text().partition("## Runs")[2].splitlines()
    cells = [line.split("|") for line in listed if "seed_" in line]
    assert [cell[3].strip() for cell in cells] == ["0", "1"] * 3


def test_a_failing_stage_leaves_the_others_and_the_command_goes_on(
    runs: PretendedRuns, capsys: Capture
) -> None:
    runs.failing = "P-FT-1"
    with pytest.raises(SystemExit) as stopped:
        run_transfer()
    assert stopped.value.code == 7
    error = capsys.readouterr().err
    folder = (OF_SEED_0 / "P-FT-1").absolute()
    assert f"stage P-FT-1 in {folder} ended with status 7" in error
    assert "the same command continues" in error
    assert not (HERE / "transfer.md").exists()

    shutil.move("runs", "elsewhere")
    runs.failing, runs.started = None, []
    run_transfer("hydra.run.dir=elsewhere/transfer/mine")
    assert [stage for _, stage in runs.started] == ["P-FT-1", "S-FT-1"]
    resumed = runs.configs[-2]
    assert resumed.resume == str(Path("elsewhere/transfer/mine/fold_1/seed_0/P-FT-1").absolute())
    assert resumed.init_from is None, "its own checkpoint has the tensors"


def test_a_folder_of_other_settings_or_files_is_refused(runs: PretendedRuns) -> None:
    run_transfer(*SHORT)
    before = len(runs.started)
    for override, message in {
        "optimizer.lr=1": r"seed_0/P: found stage P with optimizer\.lr=0\.003 \(now 1\), sch",
        "representation.blend=feather": r"/S: found stage S with representation\.blend='nearest'",
    }.items():
        with pytest.raises(REFUSED, match=message):
            run_transfer(override)
    (OF_SEED_0 / "S-FT-1").mkdir(parents=True)
    (OF_SEED_0 / "S-FT-1" / "thesis.tex").touch()
    with pytest.raises(REFUSED, match="S-FT-1: found files that tangent-transfer did not write"):
        run_transfer()
    assert len(runs.started) == before, "refused before anything is run"


def test_stages_of_a_network_that_was_trained_again_are_refused(runs: PretendedRuns) -> None:
    run_transfer(*SHORT)
    network = OF_SEED_0 / "P" / "checkpoints" / "best.ckpt"
    network.write_text("another network, longer")
    with pytest.raises(REFUSED, match=r"seed_0/S: found stage S of another network, or"):
        run_transfer(*SHORT)
    network.unlink()  # to save space: what was found stays found
    run_transfer(*SHORT)
    with pytest.raises(REFUSED, match=r"P/checkpoints/best\.ckpt: found no such file; "):
        run_transfer("compare=[erp]", "fine_tuning.epochs=[]")


def test_a_network_without_a_run_is_only_evaluated(runs: PretendedRuns, tmp_path: Path) -> None:
    network = write_checkpoint(tmp_path / "photo.ckpt")
    label_map = tmp_path / "map.json"
    label_map.write_text('{"classes": {"floor": ["dark"]}}')
    wide = "{name: wide, level: 3, blend: feather}"
    arguments = (
        *(f"checkpoint={network}", f"label_map={label_map}", f"compare=[erp,{wide}]"),
        "conditions=[upright,{name: tilted, test_rotation: 30}]",
        *("unmapped=never", "representation.erp_height=20"),
    )
    run_transfer(*arguments)
    views = ("S", "S-tilted", "S-erp", "S-erp-tilted", "S-wide", "S-wide-tilted")
    assert runs.started == [("evaluate", name) for name in ("P", *views)]
    for (_, name), config in zip(runs.started, runs.configs, strict=True):
        assert (config.checkpoint, config.network) == (str(network), None)
        assert (config.label_map, config.unmapped) == (str(label_map), "never")
        assert config.data.inputs == ["rgb"]
        assert tuple(config.data.normalization.mean) == RGB_NORMALIZATION.mean
        assert config.level == config.representation.level == (3 if "wide" in name else 4)
        if name != "P":
            assert config.representation.erp_height == 20
            assert config.data.test_rotation == (30 if "tilted" in name else None)
    first, *lines = (HERE / "transfer.md").read_text().splitlines()
    assert first == "# Transfer from photos to panoramas: mIoU by solid angle %"
    grid = [line.strip("| ").split(" | ")[0] for line in lines[1:6]]
    assert grid == ["upright", "---", "S", "erp", "wide"]

    runs.started.clear()
    (OF_SEED_0 / "S-erp-tilted" / "results.json").unlink()
    run_transfer(*arguments)
    assert runs.started == [("evaluate", "S-erp-tilted")]
    label_map.write_text('{"classes": {"floor": ["bright"]}}')
    with pytest.raises(REFUSED, match=r"seed_0/P: found stage P of another .* label map; expected"):
        run_transfer(*arguments)
    for typed in ("optimizer.lr=1", "network.widths=[4]", "fine_tuning.epochs=[1]"):
        with pytest.raises(REFUSED, match=f"{typed.split('=')[0]}=.*a setting of training with"):
            run_transfer(*arguments, typed)


def test_the_study_of_the_angular_resolution(runs: PretendedRuns) -> None:
    run_transfer("study_levels=[4,6]")
    files = {path.name for path in HERE.glob("angular_resolution.*")}
    assert files == {f"angular_resolution.{suffix}" for suffix in ("md", "csv", "png")}
    assert "from level 4" in (HERE / "angular_resolution.md").read_text()


def test_a_given_network_is_not_trained(runs: PretendedRuns, tmp_path: Path) -> None:
    given = tmp_path / "given ${x}.ckpt"
    torch.save({"config": {"data": {"fold": 1}}}, given)
    arguments = (r"checkpoint=given \${x}.ckpt", "compare=[]")
    run_transfer(*arguments)
    assert runs.started[:2] == [("evaluate", "P"), ("evaluate", "S")]
    assert runs.configs[0].checkpoint == runs.configs[2].init_from == str(given)
    with pytest.raises(REFUSED, match=r"trained on all folds but fold 1.*; expected folds=\[1\]"):
        run_transfer(*arguments, "folds=[1,2]")
