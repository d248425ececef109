"""``tangent-transfer`` from the command line to the tables, with pretended runs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from datamodules.core.inputs import RGB_NORMALIZATION
from tangent_train.cli import transfer
from tangent_train.errors import DataError, SettingError
from tangent_train.results import report
from tests.cli.pretended_runs import HERE, PretendedRuns, run_transfer
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
    monkeypatch.setattr(transfer, "run_process", pretended)
    # Tested by itself, and slow.
    monkeypatch.setattr(transfer, "_check_data", lambda *_: None)
    monkeypatch.setattr(report, "report_png", lambda *_: b"a picture")
    return pretended


def _seen(config: Any, *settings: str) -> list[Any]:
    section = config.representation
    return [section["_target_"].rpartition(".")[2][:4], *(section.get(n) for n in settings)]


def test_all_stages_run_in_order_and_the_tables_are_written(
    runs: PretendedRuns, capsys: Capture
) -> None:
    run_transfer("seed=3", "photos.data.fold=3")
    trained = ("P", "P-FT-1", "S-FT-1")
    assert runs.started == [("train" if s in trained else "evaluate", s) for s in STAGES]
    folder = (HERE / "fold_1" / "seed_3").absolute()
    assert runs.configs["P"].init_from is None
    for (command, name), config in zip(runs.started, runs.configs.values(), strict=True):
        assert (config.seed, config.data.seed, config.data.fold) == (3, 3, 1)
        assert config.name == f"mine/{name}"
        assert config.data["_target_"].endswith("Perspective") == (name[0] == "P")
        assert config.data.get("sampling_seed", 0) == ("P-FT" in name), "other crops"
        if name != "P":
            weights = config["init_from" if command == "train" else "checkpoint"]
            assert weights == str(folder / "P" / "checkpoints" / "best.ckpt")
    out = capsys.readouterr().out
    for number, stage in enumerate(STAGES, start=1):
        assert f"Stage {number} of 6, {stage} in {folder / stage}: tangent-" in out
    assert {path.suffix for path in HERE.glob("transfer.*")} == {".md", ".csv", ".png"}
    table = (HERE / "transfer.md").read_text()
    assert "| S-FT-1 | SynthRooms | 1 | 100.0 | +100.0 % | 100.0 | +100.0 % |" in table
    assert "| P | SynthRoomsPerspective | photos | 50.0 | – | 50.0 | – |" in table


def test_fine_tuning_takes_a_tenth_of_the_rate(runs: PretendedRuns) -> None:
    given = ("fine_tuning.epochs=[10]", "+fine_tuning.scheduler.max_lr=${optimizer.lr}")
    run_transfer("compare=[]", "optimizer=adamw", "optimizer.lr=3e-3", *given)
    first, tuned = runs.configs["P"], runs.configs["S-FT-10"]
    assert tuned.optimizer == {**first.optimizer, "lr": 3e-4}
    assert tuned.scheduler["_target_"].endswith("ConstantLR")
    assert tuned.scheduler.max_lr == 3e-4, "of fine-tuning, not of P"
    assert (first.trainer.max_epochs, tuned.trainer.max_epochs) == (20, 10)


def test_finished_stages_are_not_run_again(runs: PretendedRuns, capsys: Capture) -> None:
    run_transfer(*SHORT)
    runs.started.clear()
    capsys.readouterr()
    run_transfer(*SHORT, "panels=9", "logger=csv")
    assert not runs.started
    assert capsys.readouterr().out.count("finished before") == 2
    run_transfer("seeds=[0,1]", "compare=[erp]", "fine_tuning.epochs=[]")
    assert [s for _, s in runs.started] == ["S-erp", "P", "S", "S-erp"]
    listed = (HERE / "transfer.md").read_text().partition("## Runs")[2].splitlines()
    cells = [line.split("|") for line in listed if "seed_" in line]
    assert [cell[3].strip() for cell in cells] == ["0", "1"] * 3
    before = len(runs.started)
    with pytest.raises(REFUSED, match=r"optimizer: found .*; expected .*, with which"):
        run_transfer(*SHORT, "optimizer.lr=1")
    with pytest.raises(REFUSED, match=r"S-erp: found .*'rows': 16"):
        run_transfer("compare=[{name: erp, option: erp, rows: 16}]")
    assert len(runs.started) == before, "refused before anything is run"


def test_a_failing_stage_leaves_the_others_and_the_command_goes_on(
    runs: PretendedRuns, capsys: Capture
) -> None:
    runs.failing = "P-FT-1"
    with pytest.raises(SystemExit) as stopped:
        run_transfer()
    assert stopped.value.code == 7
    assert "Stage P-FT-1 ended with status 7" in capsys.readouterr().err
    assert not (HERE / "transfer.md").exists()
    shutil.move("runs", "elsewhere")
    runs.failing, runs.started = None, []
    run_transfer("hydra.run.dir=elsewhere/transfer/mine")
    assert [stage for _, stage in runs.started] == ["P-FT-1", "S-FT-1"]
    resumed = Path("elsewhere/transfer/mine/fold_1/seed_0/P-FT-1").absolute()
    assert runs.configs["P-FT-1"] == {"resume": str(resumed)}


def test_all_views_see_the_same_panoramas(runs: PretendedRuns) -> None:
    views = (
        "erp, {name: fine, option: erp, rows: 400}, {name: cube, option: cubemap, dim: 7}, "
        "{name: wide, level: 3, base_level: 0, blend: feather}"
    )
    given = ("representation.erp_height=20", "representation.dim=6", "fine_tuning.epochs=[]")
    run_transfer(f"compare=[{views}]", *given)
    assert _seen(runs.configs["S-erp"], "level", "rows") == ["Equi", 4, None]
    assert _seen(runs.configs["S-fine"], "level", "rows") == ["Equi", 4, 400]
    assert _seen(runs.configs["S-cube"], "level", "dim") == ["Cube", 4, 7]
    assert _seen(runs.configs["S-wide"], "level", "base_level", "blend", "dim") == [
        *("Tang", 3, 0, "feather", 3)
    ]
    assert [runs.configs[f"S-{name}"].level for name in ("fine", "wide")] == [4, 3]
    rows = {c.representation.get("erp_height") for n, c in runs.configs.items() if n[0] == "S"}
    assert rows == {20}


def test_an_imported_network_is_only_evaluated(runs: PretendedRuns, tmp_path: Path) -> None:
    network = write_checkpoint(tmp_path / "photo.ckpt")
    wide = "{name: wide, level: 3, blend: feather}"
    arguments = (
        "checkpoint=photo.ckpt",
        f"compare=[erp,{wide}]",
        "conditions=[upright,{name: tilted, test_rotation: 30}]",
        *("label_map=map.json", "unmapped=never", "fine_tuning.epochs=[]"),
        "representation.erp_height=20",
    )
    run_transfer(*arguments)
    views = ("S", "S-tilted", "S-erp", "S-erp-tilted", "S-wide", "S-wide-tilted")
    assert runs.started == [("evaluate", name) for name in ("P", *views)]
    for name, config in runs.configs.items():
        assert (config.checkpoint, config.network) == (str(network), None)
        assert (config.label_map, config.unmapped) == ("map.json", "never")
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


def test_the_study_of_the_angular_resolution(runs: PretendedRuns) -> None:
    run_transfer("study_levels=[3,4,6]", "study_max_rows=64", "representation.dim=6")
    assert [name for _, name in runs.started] == ["P", *(f"S-level-{n}" for n in (3, 4, 6))]
    seen = [_seen(c, "level", "erp_height", "dim") for c in runs.configs.values()][1:]
    assert seen == [["Tang", 3, 16, 3], ["Tang", 4, 32, 6], ["Tang", 6, 64, 24]]
    files = {path.name for path in HERE.glob("angular_resolution.*")}
    assert files == {f"angular_resolution.{suffix}" for suffix in ("md", "csv", "png")}
    assert "from level 4" in (HERE / "angular_resolution.md").read_text()


def test_data_without_folds_and_without_photos(runs: PretendedRuns) -> None:
    run_transfer("experiment=paper/transfer_omnisynthia_s6", "fine_tuning.epochs=[]", settings=())
    folder = Path("runs/transfer/paper/transfer_omnisynthia_s6/seed_0")
    assert (folder / "P" / "results.json").is_file()
    assert "fold" not in runs.configs["P"].data
    with pytest.raises(SettingError, match=r"data@photos\.data: found none; .*checkpoint="):
        run_transfer(settings=())
