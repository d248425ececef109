"""`tangent-evaluate predictions=`: files of any program are scored as a network is."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError
from tangent_train.io.pixel_files import write_pixels
from tests.cli.tiny_runs import SETTINGS, Run, results
from tests.datamodules.data_files import contents
from tests.inference.trained import sphere, write_checkpoint, write_depth_checkpoint
from tests.running import Capture

CLASSES = ["dark", "green", "bright"]
DATA = ("data=folder", "data.root=data")


def _truth(seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 4, (4, 8)), np.ones((8, 8))).astype(np.uint8)


@pytest.fixture
def data(tmp_path: Path) -> dict[str, NDArray[np.uint8]]:
    """Three test images of 32 × 64; the labels of the files are 10, 20 and 30."""
    root, truths = tmp_path / "data", {f"hall/{k}": _truth(k) for k in range(4)}
    for name, labels in truths.items():
        write_pixels(root / "images" / f"{name}.png", np.roll(sphere(32), len(name), axis=1))
        write_pixels(root / "labels" / f"{name}.png", labels * 10)
    (root / "train.txt").write_text("hall/3\n")
    del truths["hall/3"]
    (root / "test.txt").write_text("\n".join(truths) + "\n")
    (root / "val.txt").write_text("")
    values = {name: 10 * k for k, name in enumerate(CLASSES, start=1)}
    (root / "classes.json").write_text(json.dumps(values))
    return truths


def _wrong(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A prediction with some errors, without unknown pixels."""
    return np.where(np.roll(labels, 3, axis=1) > 0, np.roll(labels, 3, axis=1), 1).astype(np.uint8)


def _save(path: Path, array: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        np.savez(path, array)
    elif path.suffix == ".npy":
        np.save(path, array)
    else:
        write_pixels(path, array)


def _scores(run: Run, tmp_path: Path, name: str, *settings: str) -> dict[str, Any]:
    run("evaluate", "predictions=maps", *DATA, f"hydra.run.dir={name}", "panels=1", *settings)
    return results(tmp_path / name)


def _one_hot(labels: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.eye(3, dtype=np.float32)[labels - 1]


@pytest.mark.parametrize(
    ("suffix", "stored", "settings"),
    [
        (".png", lambda labels: labels - 1, ("values=from_0",)),
        (".png", lambda labels: 10 * labels, ("values=ids",)),
        (
            ".png",
            lambda labels: 255 * np.eye(4, dtype=np.uint8)[labels][..., 1:],
            ("values=c.json",),
        ),
        (".npy", lambda labels: labels.astype(np.int64), ()),
        (".npz", lambda labels: _one_hot(labels).transpose(2, 0, 1), ()),
        (".npy", lambda labels: _one_hot(labels).astype(np.float16), ()),
    ],
    ids=["from 0", "ids", "colors", "integers", "scores first", "scores last"],
)
def test_all_formats_have_the_scores_of_their_labels(
    data: Any, run: Run, tmp_path: Path, suffix: str, stored: Any, settings: tuple[str, ...]
) -> None:
    colors = {"dark": "#ff0000", "green": "#00ff00", "bright": "#0000ff"}
    (tmp_path / "c.json").write_text(json.dumps(colors))
    confusion = np.zeros((4, 4), int)
    for name, truth in data.items():
        np.add.at(confusion, (truth[truth > 0], _wrong(truth)[truth > 0]), 1)
        _save(tmp_path / "maps" / f"{name}{suffix}", stored(_wrong(truth)))
    found = _scores(run, tmp_path, "found", *settings)
    assert found["confusion"] == confusion.tolist()


def test_files_have_the_scores_of_the_network_that_wrote_them(
    data: Any, run: Run, tmp_path: Path
) -> None:
    """To the last digit, at the size of the images."""
    checkpoint = write_checkpoint(tmp_path / "net.ckpt")
    network = (
        "checkpoint=net.ckpt",
        "+representation.erp_height=32",
        "+representation.blend=nearest",
    )
    run("evaluate", *network, *DATA, "hydra.run.dir=of_network", "panels=0")
    how = ("input=data/images", "output=maps", "blend=nearest", "report=0")
    run("predict", f"checkpoint={checkpoint}", *how)
    found, expected = _scores(run, tmp_path, "of_files"), results(tmp_path / "of_network")
    for part in ("scores", "classes", "latitude_bands", "confusion", "intervals"):
        assert found[part] == expected[part], part
    assert "report.html" in contents(tmp_path / "of_files")


@pytest.mark.parametrize(("kind", "tolerance"), [("npy", 1e-6), ("png", 1e-3)])
def test_depth_files_have_the_scores_of_the_network_that_wrote_them(
    rooms: str, run: Run, tmp_path: Path, kind: str, tolerance: float
) -> None:
    """For synthetic rooms; PNG files have whole millimeters."""
    weight = 0.1 * torch.randn(1, 3, 3, 3, generator=torch.Generator().manual_seed(0))
    write_depth_checkpoint(tmp_path / "net.ckpt", tensors={"weight": weight, "bias": torch.ones(1)})
    small = [text for text in SETTINGS if text.startswith(("data", "experiment", "level"))]
    data = (*small, rooms, "task=depth", "panels=0")
    run("evaluate", "checkpoint=net.ckpt", *data, "data.inputs=[rgb]", "hydra.run.dir=of_network")
    root = rooms.partition("=")[2].strip("'")
    how = ("output=maps", "report=0", "write=[depth]", f"depth_format={kind}")
    run("predict", "checkpoint=net.ckpt", f"input='{root}/area_5*/pano/rgb/*.png'", *how)
    files = [text for text in data if not text.startswith("level")]
    run("evaluate", "predictions=maps", *files, "hydra.run.dir=of_files")
    found, expected = (results(tmp_path / name) for name in ("of_files", "of_network"))
    assert found["images"] == expected["images"] > 0
    assert expected["scores"]["absrel"] > 0.01
    for name, score in expected["scores"].items():
        if score is not None:  # without consistency
            assert found["scores"][name] == pytest.approx(score, rel=tolerance, abs=tolerance), name


def test_what_is_not_scored_is_named(data: Any, run: Run, tmp_path: Path, capsys: Capture) -> None:
    _save(tmp_path / "maps" / "0.png", _wrong(data["hall/0"]))
    _save(tmp_path / "maps" / "1.png", _wrong(data["hall/1"])[:16, :32])
    _save(tmp_path / "maps" / "stranger.png", _wrong(data["hall/1"]))
    found = _scores(run, tmp_path, "found")
    assert (found["images"], found["protocol"]["images"]) == (1, "1 of 3")
    error = capsys.readouterr().err
    for text in ("1 image without a prediction:\n  hall/2", "stranger.png", "found 32 × 16"):
        assert text in error
    resampled = _scores(run, tmp_path, "resampled", "resample=nearest")
    assert resampled["protocol"]["images"] == "2 of 3"
    assert resampled["protocol"]["resampled"] == "nearest, from 32 × 16 (width × height)"


def test_files_are_matched_by_a_list(data: Any, run: Run, tmp_path: Path) -> None:
    with (tmp_path / "list.csv").open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["image", "prediction"])
        for number, (name, truth) in enumerate(data.items()):
            _save(tmp_path / "maps" / f"x{9 - number}.png", truth)
            lines.writerow([f"{name}.png", f"x{9 - number}.png"])
    found = _scores(run, tmp_path, "found", "files=list.csv")
    assert (found["images"], found["scores"]["miou"]) == (3, 1)


@pytest.mark.parametrize(
    ("turn", "name"),
    [
        (lambda labels: labels[:, ::-1], "mirrored left to right"),
        (lambda labels: np.roll(labels, 32, axis=1), "shifted by half the width"),
        (lambda labels: np.maximum(labels, 1) - 1, "numbered from 0 (values=from_0)"),
    ],
)
def test_turned_predictions_are_noticed(
    data: Any, run: Run, tmp_path: Path, capsys: Capture, turn: Any, name: str
) -> None:
    for path, truth in data.items():
        _save(tmp_path / "maps" / f"{path}.png", turn(truth))
    _scores(run, tmp_path, "found")
    error = capsys.readouterr().err
    assert f"Warning: {name}, predictions score mIoU 100.0 instead of" in error
    assert " on 3 panoramas." in error


def test_predictions_are_checked(data: Any, run: Run, tmp_path: Path, capsys: Capture) -> None:
    """One mirrored prediction, one of another size, one missing, and a stranger."""
    files = {"0": data["hall/0"][:, ::-1], "1": data["hall/1"][:16], "stranger": data["hall/0"]}
    for name, labels in files.items():
        _save(tmp_path / "maps" / f"{name}.png", labels)
    with pytest.raises(SystemExit) as stopped:
        run("check", "predictions=maps", *DATA)
    out, err = capsys.readouterr()
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines()]
    cells = {row[0]: row[1:] for row in rows if row}
    unknown, dark = (f"{100 * np.mean(data['hall/0'] == label):.1f}" for label in (0, 1))
    assert stopped.value.code == 1
    assert cells == cells | {
        "usable predictions": ["1"],
        "images without a prediction": ["1"],
        "unusable predictions": ["1"],
        "files of no test image": ["1"],
        "unknown": [unknown, unknown],
        "dark": [dark, dark],
        "mirrored left to right": ["100.0"],
    }
    assert "Warning: mirrored left to right, predictions score mIoU 100.0 instead of" in out
    assert "hall/2" in err
    assert "stranger.png" in err
    assert not (tmp_path / "runs").exists(), "nothing is written"


def test_right_distances_pass_the_check(
    data: Any, run: Run, tmp_path: Path, capsys: Capture
) -> None:
    steps = np.full((32, 64), 2000, np.uint16)
    steps[:, 32:], steps[:8] = 3000, 0
    for name in (*data, "hall/3"):
        _save(tmp_path / "data" / "depth" / f"{name}.png", steps)
        _save(tmp_path / "maps" / f"{name}.npy", np.maximum(steps, 1000) * np.float32(1e-3))
    (tmp_path / "maps/hall/3.npy").unlink()
    run("check", "predictions=maps", *DATA, "task=depth")
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines()]
    cells = {row[0]: row[1:] for row in rows if row}
    assert (cells["usable predictions"], cells["distance"]) == (["3"], ["100.0", "75.0"])
    assert float(cells["as they are"][0]) < 1e-3 < float(cells["mirrored left to right"][0])
    assert "Warning" not in out


@pytest.mark.parametrize("is_placed", [False, True])
def test_partial_panoramas(data: Any, run: Run, tmp_path: Path, is_placed: bool) -> None:
    """Files of the part that the images show, or of whole panoramas."""
    for name, truth in data.items():
        whole = np.zeros((64, 128), np.uint8)
        whole[16:48, 32:96] = truth
        _save(tmp_path / "maps" / f"{name}.png", whole if is_placed else truth)
    found = _scores(run, tmp_path, "found", "data.area=[-90,90,-45,45]")
    assert (found["images"], found["scores"]["miou"]) == (3, 1)
    assert found["protocol"]["size"] == "128 × 64"


def test_distances(data: Any, run: Run, tmp_path: Path) -> None:
    """10 % too far: AbsRel is 0.1, by any weighting."""
    for name in (*data, "hall/3"):
        steps = np.full((32, 64), 2000, np.uint16)
        steps[:, 32:] = 3000
        _save(tmp_path / "data" / "depth" / f"{name}.png", steps)
        _save(tmp_path / "maps" / f"{name}.npy", (steps * 1.1e-3).astype(np.float32))
    found = _scores(run, tmp_path, "found", "task=depth")
    assert found["scores"]["absrel"] == pytest.approx(0.1, abs=1e-3)
    assert found["scores"]["seam_step"] == pytest.approx(0, abs=1e-3)
    run_in_units = _scores(run, tmp_path, "scaled", "task=depth", "task.head.alignment=median")
    assert run_in_units["scores"]["absrel"] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        (("predictions=maps", "representation=tangent"), "representation: found"),
        (("checkpoint=net.ckpt", "values=ids"), "values: found ids; expected null"),
        ((), "checkpoint: found null; expected a network, or predictions="),
        (("predictions=empty",), "empty: found no usable prediction for 3 panoramas"),
        (("predictions=maps", "values=c.json"), "c.json: found sofa; expected classes of dark"),
    ],
)
def test_refused(
    data: Any, run: Run, tmp_path: Path, settings: tuple[str, ...], error: str
) -> None:
    write_checkpoint(tmp_path / "net.ckpt")
    (tmp_path / "empty").mkdir()
    (tmp_path / "c.json").write_text('{"sofa": 1}')
    _save(tmp_path / "maps" / "0.png", data["hall/0"])
    with pytest.raises((SettingError, DataError, SystemExit), match=error):
        run("evaluate", *settings, *DATA)
