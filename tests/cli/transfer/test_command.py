"""``tangent-transfer`` from the command line to the tables, mostly with pretended runs."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from tangent_train.cli import main
from tangent_train.cli.transfer import stage_runs
from tangent_train.cli.transfer.report import trained_level
from tests.cli.transfer.pretended_runs import HERE, OF_SEED_0, SETTINGS, PretendedRuns, run_transfer

STAGES = ["P", "S", "S-erp", "S-cubemap", "P-FT-1", "S-FT-1"]


def test_all_stages_run_in_order_and_the_tables_are_written(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_transfer(monkeypatch)
    trained = ("P", "P-FT-1", "S-FT-1")
    assert runs.started == [("train" if s in trained else "evaluate", s) for s in STAGES]
    weights = str(Path(OF_SEED_0 / "P" / "checkpoints" / "last.ckpt").absolute())
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
        f"transfer.{suffix}" for suffix in ("md", "csv", "json", "png")
    }
    table = (HERE / "transfer.md").read_text()
    assert "| S-FT-1 | SynthRooms | 1 | 100.0 | +100.0 % | 100.0 | +100.0 % |" in table
    assert "| P | SynthRoomsPerspective | photos | 50.0 | – | 50.0 | – |" in table
    assert "Transfer from photos to panoramas" in out


def test_finished_stages_are_not_run_again(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_transfer(monkeypatch, "compare=[erp]", "fine_tuning.epochs=[]")
    before = (HERE / "transfer.json").read_text()
    runs.started.clear()
    capsys.readouterr()
    free = ("panels=9", "+trainer.strategy=ddp", "data.root=other", "task.images_per_forward=3")
    run_transfer(monkeypatch, "compare=[]", "fine_tuning.epochs=[]", *free)
    assert not runs.started
    assert capsys.readouterr().out.count("finished before") == 2
    assert (HERE / "transfer.json").read_text() != before, "S-erp was not asked for"
    run_transfer(monkeypatch)
    assert [stage for _, stage in runs.started] == ["S-cubemap", "P-FT-1", "S-FT-1"]


def test_a_failing_stage_leaves_the_others_and_the_command_goes_on(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs.failing = "P-FT-1"
    with pytest.raises(SystemExit) as stopped:
        run_transfer(monkeypatch)
    assert stopped.value.code == 7
    error = capsys.readouterr().err
    folder = (OF_SEED_0 / "P-FT-1").absolute()
    assert f"stage P-FT-1 in {folder} ended with status 7" in error
    assert "the same command goes on" in error
    assert (OF_SEED_0 / "S-cubemap" / "results.json").is_file()
    assert not (HERE / "transfer.md").exists()

    runs.failing, runs.started = None, []
    run_transfer(monkeypatch)
    assert [stage for _, stage in runs.started] == ["P-FT-1", "S-FT-1"]
    resumed = runs.configs[-2]
    assert resumed.resume == str(folder), "it had begun"
    assert resumed.init_from is None, "its own checkpoint has the tensors"
    assert f"tangent-train resume={folder} data.root=data/" in capsys.readouterr().out
    assert (HERE / "transfer.md").is_file()


def test_a_stage_that_did_not_begin_may_get_other_settings(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs.failing = "S"
    with pytest.raises(SystemExit):
        run_transfer(monkeypatch)
    runs.failing = None
    run_transfer(monkeypatch, "representation.blend=feather", "compare=[]")
    assert (OF_SEED_0 / "S-FT-1" / "results.json").is_file()


def test_other_seeds_in_the_folder_are_in_the_tables(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short = ("compare=[]", "fine_tuning.epochs=[]")
    run_transfer(monkeypatch, "seeds=[1,2]", *short)
    assert [s for _, s in runs.started] == ["P", "S", "P", "S"]
    assert [config.seed for config in runs.configs] == [1, 1, 2, 2]
    runs.started.clear()
    run_transfer(monkeypatch, "seeds=[3]", "folds=[1]", *short)
    (HERE / "fold_1" / "seed_4x").mkdir()
    assert [s for _, s in runs.started] == ["P", "S"]
    report = json.loads((HERE / "transfer.json").read_text())
    assert "seed_1" in json.dumps(report)
    assert "seed_3" in json.dumps(report)
    capsys.readouterr()
    run_transfer(monkeypatch, "seeds=[7]", "optimizer.lr=1", *short)
    out = capsys.readouterr().out
    assert f"{(HERE / 'fold_1/seed_1/P').absolute()}: of other settings" in out
    assert "seed_1" not in (HERE / "transfer.json").read_text()


def test_the_study_of_the_angular_resolution(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_transfer(monkeypatch, "study=angular_resolution", "study_levels=[3,4,6]")
    names = ["P", "S-level-3", "S-level-4", "S-level-6"]
    assert [stage for _, stage in runs.started] == names
    seen = [config.representation.erp_height for config in runs.configs[1:]]
    assert seen == [16, 32, 32]
    levels = {path.name for path in HERE.glob("angular_resolution.*")}
    assert levels == {f"angular_resolution.{suffix}" for suffix in ("md", "csv", "json", "png")}
    assert "against level 4" in (HERE / "angular_resolution.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data.fold=2", "folds=[1]"], r"data\.fold=2: found folds=\[1\] beside it"),
        (["seed=2", "seeds=[0,1]"], r"seed=2: found seeds=\[0, 1\] beside it"),
        (["compare=[erb]"], "unknown representation: found 'erb'.*Did you mean erp"),
        (["compare=erp"], "compare: found erp; expected a list"),
        (["checkpoint=nowhere.ckpt"], r"nowhere\.ckpt: found no such file"),
    ],
)
def test_what_cannot_work_is_refused(
    runs: PretendedRuns, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit, match=rf"^tangent-transfer: .*{message}"):
        run_transfer(monkeypatch, *arguments)
    assert not runs.started


def test_what_no_stage_can_do_is_said_before_the_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        SystemExit, match=r"^tangent-transfer: stage P, in photos: image size for the "
    ):
        run_transfer(monkeypatch)
    dims = ("level=6", "representation.base_level=2", "compare=[]")
    wrong = "representation.faces_per_panorama=9999"
    with pytest.raises(
        SystemExit, match=r"stage S: representation\.faces_per_panorama: found 9999"
    ):
        run_transfer(monkeypatch, *dims, wrong)
    alike = (
        r"stage S: data\.inputs: found \('rgb', 'depth'\); expected \('rgb',\), as in the stages"
    )
    with pytest.raises(SystemExit, match=alike):
        run_transfer(monkeypatch, *dims, "photos.data.inputs=[rgb]")
    assert not (tmp_path / "data").exists()


def test_another_representation_takes_the_place_of_tangent_images(
    runs: PretendedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = [text for text in SETTINGS if not text.startswith("representation.")]
    monkeypatch.setattr(sys, "argv", ["tangent-transfer", *typed, "representation=erp"])
    main.transfer()
    names = [stage for _, stage in runs.started]
    assert names == ["P", "S", "S-cubemap", "P-FT-1", "S-FT-1"], "S is S-erp"
    erp = {"_target_", "level", "crop_deg", "rotation", "mirror", "erp_height"}
    assert set(runs.configs[1].representation) == erp, "and no base level of the experiment"
    assert "| S | SynthRooms | ERP |" in (HERE / "transfer.md").read_text()


def test_the_level_of_the_photos() -> None:
    """f' = 128 / (2 tan 22.5°) = 154.5 pixels; at level 8, b = 1, p = 1.10715 / 128."""
    photos = {"_target_": "tangent_train.rendering.PerspectiveRepresentation", "level": 8}
    tangent = {
        "_target_": "tangent_train.rendering.TangentRepresentation",
        "base_level": 1,
        "level": 8,
    }
    config = OmegaConf.create(
        {"level": 8, "photos": {"representation": photos}, "representation": tangent}
    )
    expected = 8 + np.log2(128 / (2 * np.tan(np.pi / 8)) * 1.1071487 / 128)
    assert trained_level(config) == pytest.approx(expected, abs=1e-6)
    assert expected == pytest.approx(8.418, abs=1e-3)
    # A crop with the focal length of tangent images is as fine as they are.
    config.photos.representation.dim = 128
    config.photos.representation.fov_deg = float(np.degrees(2 * np.arctan(1.1071487 / 2)))
    assert trained_level(config) == pytest.approx(8, abs=1e-6)
    config.representation = {
        "_target_": "tangent_train.rendering.EquirectRepresentation",
        "level": 8,
        "erp_height": 512,
    }
    focal = 128 / 1.1071487
    assert trained_level(config) == pytest.approx(8 + np.log2(focal * np.pi / 512), abs=1e-6)


@pytest.mark.slow
def test_real_runs_from_photos_to_panoramas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my" / "network").mkdir(parents=True)
    (tmp_path / "my" / "network" / "plain.yaml").write_text(
        "_target_: torch.nn.Conv2d\nin_channels: 4\nout_channels: 14\nkernel_size: 1\n"
    )
    # Must not be imported in place of this project's.
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "__init__.py").write_text("raise ImportError('the wrong models')\n")
    network = ("network=plain", "compare=[]", "trainer.max_epochs=2", "--config-dir=my")
    run_transfer(monkeypatch, *network)
    stages = ["P", "S", "P-FT-1", "S-FT-1"]
    found = {name: json.loads((OF_SEED_0 / name / "results.json").read_text()) for name in stages}
    assert [found[name]["images"] for name in stages] == [4, 2, 4, 2], "photos, panoramas"
    assert found["S"]["confusion"] != found["S-FT-1"]["confusion"]
    p, tuned = (
        torch.load(OF_SEED_0 / name / "checkpoints" / "last.ckpt", weights_only=True)
        for name in ("P", "S-FT-1")
    )
    assert tuned["config"]["optimizer"]["lr"] == 3e-4
    assert tuned["config"]["representation"]["level"] == p["config"]["representation"]["level"]
    assert tuned["epoch"] == 0
    (optimizer,) = tuned["optimizer_states"]
    assert int(optimizer["state"][0]["step"]) == tuned["global_step"] > 0, "a new optimizer"
    assert not torch.equal(tuned["state_dict"]["network.weight"], p["state_dict"]["network.weight"])

    before = (HERE / "transfer.csv").read_text()
    (OF_SEED_0 / "S-FT-1" / "results.json").unlink()
    shutil.rmtree(OF_SEED_0 / "S")
    capsys.readouterr()
    run_transfer(monkeypatch, *network)
    out = capsys.readouterr().out
    assert out.count("finished before") == 2
    assert f"tangent-train resume={(OF_SEED_0 / 'S-FT-1').absolute()} data.root=" in out
    assert (HERE / "transfer.csv").read_text() == before, "the same figures again"
    left = {path.name for path in tmp_path.iterdir() if path.name[0] != "."}  # those are coverage's
    assert left == {"data", "models", "my", "runs"}


def test_ctrl_c_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, runs: PretendedRuns, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stage_runs, "run_process", interrupted)
    with pytest.raises(SystemExit) as stopped:
        run_transfer(monkeypatch)
    assert stopped.value.code == 130
    assert "Finished stages stay; the same command goes on" in capsys.readouterr().err
    assert (OF_SEED_0 / "P" / "stage.yaml").is_file()
