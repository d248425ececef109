"""The commands end to end on a few tiny synthetic rooms: train, interrupt, resume, evaluate."""

from __future__ import annotations

import errno
import inspect
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import cv2
import lightning
import numpy as np
import pytest
import torch
from torch import nn

from datamodules import SynthRooms
from datamodules.core.data_module import DataModule
from tangent_train.checkpoints.content import read_settings
from tangent_train.cli import main
from tangent_train.cli.compose import path_text
from tangent_train.cli.stored import stored_run
from tangent_train.cli.trials import find_fault
from tangent_train.console import print_text
from tangent_train.results.evaluation_result import load_result
from tangent_train.results.tables import Table
from tangent_train.tasks.segmentation import SegmentationTask
from tests.cli.tiny_runs import SETTINGS, SMALL_ROOMS, Run, results
from tests.running import run_python

CUT_SHORT = """
import os, signal
from tangent_train.cli.main import train
from tangent_train.callbacks.checkpoints import LastCheckpoint

original = LastCheckpoint.on_train_batch_end

def cut_short(self, trainer, *rest):
    if trainer.global_step == 2:
        os.kill(os.getpid(), signal.SIGTERM)
    original(self, trainer, *rest)

LastCheckpoint.on_train_batch_end = cut_short
train()
"""


def test_a_run_leaves_everything_in_its_folder(run_folder: Path) -> None:
    found = results(run_folder)
    assert found["images"] == 2
    assert len(found["classes"]) == 13
    for name in ("results.md", "results.csv", "config.yaml", "validation.json"):
        assert (run_folder / name).is_file(), name
    assert list((run_folder / "tensorboard").glob("events.*"))
    (panel,) = (run_folder / "panels").glob("*.png")
    picture = cv2.imread(str(panel))
    assert picture is not None
    assert picture.shape[1] == 2 * 512 + 8
    page = (run_folder / "report.html").read_text()
    assert all(f"<h2>{title}</h2>" in page for title in ("Per class", "Confusion"))
    for name in ("best", "last"):
        content = torch.load(run_folder / "checkpoints" / f"{name}.ckpt", weights_only=True)
        assert content["config"]["data"]["rooms"]["height"] == 32
        assert content["predicts"] == "pixel_classes"
        assert content["inputs"] == ["rgb", "depth"]
        assert content["class_names"][:2] == ["unknown", "beam"]
        assert content["tangent_train_version"]


def test_a_terminated_run_goes_on_as_if_nothing_had_happened(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "cut_short.py").write_text(CUT_SHORT)
    cut = run_python(tmp_path, "cut_short.py", *SETTINGS, rooms, "hydra.run.dir=cut")
    assert cut.returncode == 128 + signal.SIGTERM, cut.stderr
    assert "Traceback" not in cut.stderr
    begun, *printed = shlex.split(cut.stderr.strip().splitlines()[-1])
    # Where the rooms are is remembered on this machine.
    resume = [f"resume={tmp_path / 'cut'}", "trainer.accelerator=cpu"]
    assert begun == "tangent-train"
    assert sorted(printed) == sorted(resume)
    run("train", *resume)
    found, expected = (
        torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
        for folder in (tmp_path / "cut", run_folder)
    )
    for part in ("state_dict", "optimizer_states"):
        torch.testing.assert_close(found[part], expected[part], rtol=0, atol=0)
    assert found["lr_schedulers"] == expected["lr_schedulers"]
    assert results(tmp_path / "cut") == results(run_folder)


def test_ctrl_c_ends_a_run_with_the_status_of_a_shell(
    rooms: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(SegmentationTask, "training_step", interrupted)
    before = signal.getsignal(signal.SIGINT)  # Lightning ignores further ones
    with pytest.raises(SystemExit) as ended:
        run("train", *SETTINGS, rooms, "hydra.run.dir=cut")
    signal.signal(signal.SIGINT, before)
    assert ended.value.code == 128 + signal.SIGINT


def test_a_checkpoint_within_an_epoch_holds_the_average_with_its_last_step(
    rooms: str, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights: list[dict[str, torch.Tensor]] = []
    step = SegmentationTask.training_step

    def kept(task: SegmentationTask, *arguments: Any) -> torch.Tensor:
        weights.append({n: p.detach().double().clone() for n, p in task.named_parameters()})
        if len(weights) == 4:
            raise CutError
        return step(task, *arguments)

    class CutError(Exception):
        pass

    monkeypatch.setattr(SegmentationTask, "training_step", kept)
    typed = ("ema=0.7", "checkpoint_every_n_steps=1", "data.batch_size=1")
    with pytest.raises(CutError):
        run("train", *SETTINGS, rooms, *typed, "hydra.run.dir=run")
    content = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert content["global_step"] == 3
    found: dict[str, torch.Tensor] = {}
    for name, third in weights[3].items():  # the average begins with the first step
        first, second = weights[1][name], weights[2][name]
        expected = 0.7 * (0.7 * first + 0.3 * second) + 0.3 * third
        found[name] = (content["state_dict"][name].double() - expected).abs().max()
        assert torch.equal(content["current_model_state"][name].double(), third)
    assert max(found.values()) < 1e-6
    assert max((w - weights[2][n]).abs().max() for n, w in weights[3].items()) > 1e-4


def test_without_validation_the_last_epoch_is_tested(rooms: str, tmp_path: Path, run: Run) -> None:
    checkpoints = tmp_path / "run" / "checkpoints"
    typed = ("scheduler=constant", "data.val_fraction=0", "trainer.max_epochs=1")
    run("train", *SETTINGS, rooms, *typed, "hydra.run.dir=run")
    first = (checkpoints / "best.ckpt").read_bytes()
    assert first == (checkpoints / "last.ckpt").read_bytes()
    run("train", "resume=run", rooms, "trainer.max_epochs=2")
    assert first != (checkpoints / "best.ckpt").read_bytes()
    assert results(tmp_path / "run")["images"] == 2


def test_without_test_images_training_ends_without_results(
    rooms: str,
    tmp_path: Path,
    run: Run,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = SynthRooms.files
    monkeypatch.setattr(SynthRooms, "files", lambda s, p: [] if p == "test" else files(s, p))
    run("train", *SETTINGS, rooms, "trainer.max_epochs=1", "hydra.run.dir=run")
    assert "No panoramas to test: no results are written." in capsys.readouterr().out
    assert (tmp_path / "run" / "checkpoints" / "best.ckpt").is_file()
    assert not list((tmp_path / "run").glob("results.*"))


def test_an_evaluation_repeats_the_figures_exactly(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run
) -> None:
    odd = tmp_path / "a=b (1)" / "x.ckpt"
    odd.parent.mkdir()
    shutil.copy(run_folder / "checkpoints" / "best.ckpt", odd)
    run("evaluate", f"checkpoint={odd}", rooms, "hydra.run.dir=again")
    assert results(tmp_path / "again") == results(run_folder)
    again, before = (load_result(folder).settings for folder in (tmp_path / "again", run_folder))
    differing = {n for n in again.keys() | before.keys() if again.get(n) != before.get(n)}
    assert differing == {"checkpoint", "trainer.accelerator"}, "the processor is chosen anew"


def test_where_data_are_is_remembered_by_the_place_of_the_run_and_never_in_it(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = run_folder / "checkpoints" / "best.ckpt"
    run("evaluate", f"checkpoint={best}", "hydra.run.dir=again")
    assert results(tmp_path / "again") == results(run_folder)
    found = read_settings(tmp_path / "again" / "config.yaml")["data"]["root"]
    assert found == path_text(rooms.partition("=")[2])
    moved = stored_run("evaluate", [f"checkpoint={best}", "data.root=moved"])
    assert moved is not None
    assert moved.user_overrides == ["data.root=moved"]

    shutil.copytree(run_folder, tmp_path / "theirs")
    for name, home in (("theirs", None), (str(run_folder), str(tmp_path / "other machine"))):
        if home is not None:
            monkeypatch.setenv("XDG_STATE_HOME", home)
        with pytest.raises(SystemExit, match=r"data\.root: found null: paths are not taken"):
            run("evaluate", f"checkpoint={name}/checkpoints/best.ckpt")
    assert not [path for path in run_folder.rglob("*.json") if "data.root" in path.read_text()]


@pytest.mark.parametrize(
    ("command", "override", "message"),
    [
        ("train", "optimizer.lr=1", r"optimizer\.lr: found 1 for a run that began with 0\.003"),
        ("train", "seed=3", r"seed: found 3 for a run that began with 0"),
        ("train", "network.widths=[4,9]", r"network\.widths: found \[4, 9\]"),
        ("train", "data=folder", r"found data=folder in the same"),
        ("train", "trainer.max_epochs=1", r"max_epochs: found 1 for a run that is in its epoch 2"),
        ("train", "trainer.max_epochs=3", r"trainer\.max_epochs, .*: found 12 training steps"),
        ("evaluate", "data.inputs=[rgb]", "network: found .*|found inputs .* which the"),
        ("evaluate", "data=omnisynthia", r"found class names .*'sky'.*; expected .*'beam'"),
        ("evaluate", "network.widths=[4,9]", "network: found other tensors than in"),
        ("evaluate", "experiment=rooms/demo", r"found experiment=rooms/demo in the same"),
        ("evaluate", "recipe=small", r"found recipe=small in the same"),
        ("evaluate", "optimizer.lr=3", r"optimizer\.lr: .*tangent-evaluate does not train"),
        ("evaluate", "+scheduler.gamma=1", r"scheduler\.gamma: .*tangent-evaluate does not train"),
    ],
)
def test_a_run_is_neither_resumed_nor_evaluated_as_another(
    run_folder: Path, rooms: str, command: str, override: str, message: str, run: Run
) -> None:
    checkpoint = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    begun = {"train": f"resume={run_folder}", "evaluate": checkpoint}
    with pytest.raises(SystemExit, match=message):
        run(command, begun[command], rooms, override)


def test_a_trial_of_a_network_finds_its_fault_whatever_the_memory_holds() -> None:
    """Numbers in the buffers of some networks are indices."""

    class Indexed(nn.Module):
        index: torch.Tensor

        def __init__(self) -> None:
            super().__init__()
            self.norm = nn.BatchNorm2d(3)
            self.register_buffer("index", torch.tensor([0]))

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return self.norm(images[:, :, self.index, :1])

    torch.use_deterministic_algorithms(True)  # new memory is filled with large numbers
    try:
        assert "more than 1 value" in str(find_fault(Indexed(), (1, 3, 4, 4), trains=True))
        assert find_fault(Indexed(), (2, 3, 4, 4), trains=True) is None
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("faces", [1, 2])
def test_the_last_step_of_an_epoch_is_tried_before_training(
    faces: int, rooms: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """7 panoramas, 2 per step; DeepLab's pooled features have one value per image and channel."""

    class BegunError(Exception):
        pass

    def begin(*_: object) -> None:
        raise BegunError

    monkeypatch.setattr(DataModule, "class_weights", begin)  # reads the labels
    settings = [text for text in SETTINGS if not text.startswith("network.")]
    settings += ["network=deeplabv3_mobilenet", "data.inputs=[rgb]", "data.val_fraction=0"]
    settings += [f"representation.faces_per_panorama={faces}", "scheduler=constant"]
    message = r"data.batch_size: found 2, so that in a step of 1 panorama .*\(1, 3, 16, 16\)"
    refused = pytest.raises(SystemExit, match=message)
    with refused if faces == 1 else pytest.raises(BegunError):
        run("train", *settings, rooms, "hydra.run.dir=run")


def test_level_views_are_trained_evaluated_and_predicted(
    rooms: str, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    """With attention between views; rows unlike columns; evaluated with and without the whole."""
    network = ("network=unet_small_context", "network.network.network.widths=[4,8,8,8,8]")
    views = [
        "representation=horizontal_wide",
        "representation.dim=[32,48]",
        "representation.mirror=true",
    ]
    views += ["representation.faces_per_panorama=4", "representation.random_rotation=yaw"]
    small = (
        *SMALL_ROOMS,
        "data=synthrooms",
        "data.inputs=[rgb]",
        "trainer.max_epochs=1",
        "panels=0",
    )
    run("train", *small, *network, *views, rooms, "hydra.run.dir=level")
    checkpoint = f"checkpoint={tmp_path / 'level' / 'checkpoints' / 'best.ckpt'}"
    run("evaluate", checkpoint, rooms, "hydra.run.dir=again")
    assert results(tmp_path / "again")["confusion"] == results(tmp_path / "level")["confusion"]
    run("evaluate", checkpoint, rooms, "representation.rotations=2", "hydra.run.dir=twice")
    assert results(tmp_path / "twice")["confusion"] != results(tmp_path / "level")["confusion"]
    cv2.imwrite("room.png", np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8))
    run("predict", checkpoint, "input=room.png", "output=labels", "rotations=2")
    assert "labeled in 32 views of 48 × 32 (" in capsys.readouterr().out


def test_settings_of_an_evaluation(run_folder: Path, rooms: str, run: Run) -> None:
    arguments = [f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}", rooms]
    same = [text for text in SETTINGS if text.startswith("data.rooms.")]
    changes = (
        ["data.test_rotation=so3", "seed=1"],
        ["data.test_rotation=so3", "seed=2"],
        [*same, "data=synthrooms", "representation=erp"],
    )
    confusions = [results(run_folder)["confusion"]]
    for number, changed in enumerate(changes):
        run("evaluate", *arguments, *changed, f"hydra.run.dir={number}")
        confusion = results(Path(str(number)))["confusion"]
        assert confusion not in confusions
        confusions.append(confusion)
    config = read_settings(Path("2/config.yaml"))
    assert config["data"]["batch_size"] == 4, "the option's own, not the run's"
    assert "base_level" not in config["representation"]
    assert config["representation"]["level"] == 4


_SCHEDULER = "scheduler._target_=torch.optim.lr_scheduler"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["representation.faces_per_panorama=99"], "representation.faces_per_panorama: found 99"),
        (["level=high"], "level: found high; expected a whole number"),
        (["task.channels_last=maybe"], "task.channels_last: found maybe; expected bool"),
        (["network=unet"], "image size for the UNet: found 48 × 48"),
        (["network.num_classes=5"], "scores of the network"),
        (["network.in_channels=3"], "network: found UNet, which does not take"),
        (["task=classification"], "task: found ClassificationTask, which needs image_class"),
        (["checkpoint_every_n_steps=0"], "checkpoint_every_n_steps: found 0"),
        (["validation_images=-1"], "validation_images: found -1"),
        (["panels=-1"], "panels: found -1"),
        (["seed=abc"], "seed: found abc"),
        (["network.widths=8"], "network: found models.UNet cannot be made"),
        (["optimizer.lr=abc"], "optimizer: found .*; expected settings that torch.optim"),
        (["trainer.max_epochs=0"], "trainer.max_epochs: found 0"),
        (["trainer.precision=fp16"], "trainer: found .*Precision 'fp16' is invalid"),
        (["task.backbone_lr_factor=0.5"], r"lr_factor: found 0\.5; .*without init_from="),
        (["hydra.run.dir=file/run"], "file/run: found not a directory"),
        (
            ["network=deeplabv3_mobilenet", "data.inputs=[rgb]", "task.view_batch_size=1"],
            r"task.view_batch_size: found 1, .* DeepLabV3 gets \(1, 3, .*more than 1 value",
        ),
        (["data=folder"], "data: found rooms for datamodules.FolderPanoramas; .*recipe=small"),
        (["data=synthshapes"], "data: found batch_size, rooms for .*SynthShapes"),
        (["data=zind_pairs"], "data: found ZindPairs; expected labeled images"),
        (
            ["scheduler=step", f"{_SCHEDULER}.ExponentialLR"],
            "found step_size for .*~scheduler.step",
        ),
        (
            ["scheduler=step", f"{_SCHEDULER}.CosineAnnealingLR"],
            "found step_size, gamma for .*T_max",
        ),
        (["~scheduler.max_lr", "~scheduler.pct_start", f"{_SCHEDULER}.StepLR"], "step_size"),
        (
            ["scheduler=cosine", "scheduler.T_max=abc"],
            "scheduler: found .*; expected settings that .*CosineAnnealingLR accepts",
        ),
        (
            ["network._target_=tests.cli.tiny_runs.results"],
            "found .* for tests.cli.tiny_runs.results",
        ),
    ],
)
def test_impossible_settings_are_refused_before_any_data_is_made(
    overrides: list[str], message: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=rf"^tangent-train: .*{message}"):
        run("train", "experiment=rooms/demo", "trainer.accelerator=cpu", *overrides)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("command", "argument", "message"),
    [
        ("train", "--help", "backbone_lr_factor: 1.0       # factor of the learning rate"),
        ("train", "levl=5", "Key 'levl' is not in struct"),
        ("evaluate", "levels=9", "Is representation.levels meant?"),
        ("train", "area=[0,1,2,3]", "Is data.area meant?"),
        ("train", "task.alignment=none", "It is a setting of task=depth"),
        ("train", "representation.margin=1", "It is a setting of representation=cubemap"),
        ("transfer", "photos.data.rot=x", "Is photos.data.root meant?"),
        ("train", "experiment=rooms/demmo", "Is rooms/demo or rooms/depth or "),
        ("train", "experiment=densepass", "Is field/cityscapes_densepass or field/cityscapes_d"),
        ("train", "experiment=rooms/transfer", "Is tangent-transfer meant?"),
        ("import_network", "level=9", "Is levels meant?"),
        ("report", "--help", "runs/paper/semseg_s7_b0_rgbd --output"),
    ],
)
def test_answers_before_anything_heavy_is_imported(
    command: str, argument: str, message: str, tmp_path: Path
) -> None:
    code = (
        f"import sys; from tangent_train.cli.main import {command}\n"
        f"sys.argv = ['tangent-{command}', '{argument}']\n"
        f"try:\n    {command}()\n"
        "finally:\n    heavy = {'torch', 'lightning', 'cv2', 'numba'} & set(sys.modules)\n"
        "    print('heavy', len(heavy))"
    )
    done = run_python(tmp_path, "-c", code)
    assert message in done.stdout + done.stderr
    assert "heavy 0" in done.stdout
    assert "Traceback" not in done.stderr


MISSING = """
import sys
from tangent_train.cli import main
for line in sys.argv[1:]:
    command, *arguments = line.split(" ")
    sys.argv = [f"tangent-{command}", *arguments]
    try:
        getattr(main, command.replace("import", "import_network"))()
    except SystemExit as refused:
        print(refused)
print("heavy", {"torch", "lightning", "cv2", "numba", "matplotlib"} & set(sys.modules))
"""


def test_missing_inputs_are_refused_before_anything_heavy_is_imported(tmp_path: Path) -> None:
    name = "absent/ä\N{NO-BREAK SPACE}b"
    lines = [
        f"predict checkpoint={name} input=there output=out",
        f"predict checkpoint=there input={name} output=out",
        f"predict checkpoint=there input={name}/*.jpg output=out",
        f"predict checkpoint=there input=there output=out depth={name}",
        f"predict checkpoint=there input=there output=out mask={name}",
        f"predict checkpoint=there input=there output=out label_map={name}.json",
        f"render input={name} output=out",
        f"render back={name} output=out",
        f"render poses={name} output=out",
        f"render input=there colmap=true mask={name} output=out",
        f"export checkpoint={name} output=out.onnx",
        f"import network=onnx file={name} output=out.onnx",
        f"import network=onnx file=there classes={name} output=out.onnx",
        f"keypoints left={name} right=there output=out",
        f"keypoints input={name} output=out",
        f"keypoints data=zind_pairs data.root={name} output=out",
        *(f"{c} data=folder data.root={name}" for c in ("train", "prepare", "check", "transfer")),
        f"train data=omnisynthia data.root={name}",
        f"train init_from={name}",
        f"train resume={name}",
        f"evaluate checkpoint={name}",
        f"evaluate checkpoint={name}.onnx data=folder",
        f"transfer checkpoint={name}",
        f"report {name}",
        "train level=high",
        "predict checkpoint=there input=there output=out report=many",
    ]
    (tmp_path / "there").touch()
    done = run_python(tmp_path, "-c", MISSING, *lines)
    *refused, heavy = done.stdout.splitlines()
    assert heavy == "heavy set()"
    assert len(refused) == len(lines), done.stderr
    for line, message in zip(lines, refused, strict=True):
        command, at_fault = line.partition(" ")[0], name if name in line else "level: |report: "
        assert re.match(rf"tangent-{command}: .*({at_fault}).*found ", message), (line, message)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_output_of_any_encoding(
    encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", encoding)
    monkeypatch.setattr(sys, "argv", ["tangent-report", "Küche\udcff"])
    with TextIOWrapper(BytesIO(), encoding) as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with pytest.raises(SystemExit, match=r"Küche.*no such folder"):
            main.report()
        print_text("→ ×\udcff")
        Table("°", ("Küche", "緑"), [["…", "⅓"]]).print()
        stream.flush()
        assert stream.buffer.getvalue()
    code = "import sys; from tangent_train.cli import main; sys.argv = ['x', '-h']; main.predict()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert b"label_map: null" in done.stdout


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC])
@pytest.mark.parametrize("named", [True, False])
def test_errors_of_the_system_are_one_line(
    number: int, named: bool, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(_: object) -> None:
        raise OSError(number, os.strerror(number), *(("[red]/\x1b[2Jfile",) if named else ()))

    monkeypatch.setattr("tangent_train.cli.render.render", render)
    with pytest.raises(SystemExit) as ended:
        run("render")
    name = r"\[red\]/\\x1b\[2Jfile" if named else "output"
    message = rf"tangent-render: {name}: found {os.strerror(number)}.*; expected .*"
    assert re.fullmatch(message, str(ended.value), re.IGNORECASE)


def test_an_error_of_a_thread_that_is_raised_again_is_not_printed_twice(
    run: Run, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Writer(threading.Thread):
        exception: OSError | None = None

        def run(self) -> None:
            self.exception = OSError(errno.ENOSPC, "No space left on device")
            raise self.exception

    def render(_: object) -> None:
        writer = Writer()
        writer.start()
        writer.join()
        assert writer.exception is not None
        raise writer.exception

    monkeypatch.setattr("tangent_train.cli.render.render", render)
    before = threading.excepthook
    with pytest.raises(SystemExit, match="no space left on device"):
        run("render")
    assert threading.excepthook is before
    assert "Traceback" not in capfd.readouterr().err


def test_names_are_printed_without_escapes_and_markup(capsys: pytest.CaptureFixture[str]) -> None:
    name = "[red]sofa\x1b[2J\x9b\x07"
    print_text(name)
    Table(name, (name,), [[name]], note=name).print()
    printed = capsys.readouterr().out
    assert printed.count(r"[red]sofa\x1b[2J\x9b\x07") == 5
    assert not re.search(r"[\x07\x1b\x9b]", printed)


def test_a_pipe_that_is_closed_early_and_tab_completion(tmp_path: Path) -> None:
    train = f"{sys.executable} -m tangent_train.cli.main train"
    typed = "tangent-train data=folder_"
    completion = f"COMP_LINE='{typed}' COMP_POINT={len(typed)} {train} -sc query=bash"
    for command, beginning in (
        (f"{train} --help | head -n 1", "Train a network"),
        (completion, "data=folder_photos"),
    ):
        done = subprocess.run(
            command, shell=True, check=True, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.stdout.startswith(beginning)
        assert not done.stderr


@pytest.mark.parametrize("limit", ["debug=fast", "+trainer.limit_test_batches=1", "batches=0"])
def test_an_incomplete_test_leaves_no_results(
    limit: str, rooms: str, tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = limit.replace("batches=0", "+trainer.limit_test_batches=0")
    run("train", *SETTINGS, rooms, "trainer.max_epochs=1", typed, "hydra.run.dir=run")
    count = 0 if limit == "batches=0" else 1
    assert (
        f"{count} of 2 test panoramas were evaluated because of trainer.limit"
        in capsys.readouterr().out
    )
    assert not list((tmp_path / "run").glob("results.*"))
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    run("evaluate", f"checkpoint={checkpoint}", rooms, "hydra.run.dir=whole")
    assert results(tmp_path / "whole")["images"] == 2
    one = ("+trainer.limit_test_batches=0.5", "hydra.run.dir=part")
    run("evaluate", f"checkpoint={checkpoint}", rooms, *one)
    assert "1 of 2 test panoramas were evaluated" in capsys.readouterr().out
    assert not list((tmp_path / "part").glob("results.*"))


def test_the_calls_from_a_command_to_its_training(
    rooms: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    class BegunError(Exception):
        pass

    def fit(*_: object, **__: object) -> None:
        package = str(Path(main.__file__).parents[1])
        calls.extend(f.function for f in inspect.stack() if f.filename.startswith(package))
        raise BegunError

    monkeypatch.setattr(lightning.Trainer, "fit", fit)
    with pytest.raises(BegunError):
        run("train", *SETTINGS, rooms, "hydra.run.dir=run")
    assert calls == ["train", "_run", "job", "_main"]
