"""`tangent-evaluate` of runs, of imported and exported networks, and with label maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from numpy.typing import NDArray
from PIL import Image

from datamodules.stanford2d3ds.files import CLASSES
from tangent_train.metrics.scores import TURNS
from tests.cli.tiny_runs import SMALL_ROOMS, Run, results
from tests.inference.trained import (
    TANGENT,
    sphere,
    write_checkpoint,
    write_depth_checkpoint,
)
from tests.running import Capture, Patch

ROOMS = [
    "data=synthrooms",
    "panels=1",
    *(text for text in SMALL_ROOMS if text.startswith(("data.rooms.", "trainer."))),
]
MAP = {"source": "painters", "classes": {"floor": ["dark"], "ceiling": ["bright"]}}


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An imported network of the classes dark, green and bright, trained at level 4."""
    return f"checkpoint={write_checkpoint(tmp_path_factory.mktemp('network') / 'photo.ckpt')}"


def _best(run_folder: Path) -> str:
    return f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"


def _written(path: Path, content: Any) -> str:
    path.write_text(json.dumps(content))
    return f"label_map={path}"


def _config(folder: str) -> Any:
    return yaml.safe_load(Path(folder, "config.yaml").read_text())


def _confusion(folder: Path) -> Any:
    return np.asarray(results(folder)["confusion"])


def test_a_run_is_evaluated_as_after_its_training(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run
) -> None:
    run("evaluate", _best(run_folder), *ROOMS, rooms, "hydra.run.dir=again")
    assert results(tmp_path / "again") == results(run_folder)
    with pytest.raises(SystemExit, match=r"hydra\.run\.dir: found .*again, the folder of another"):
        run("evaluate", _best(run_folder), *ROOMS, rooms, "hydra.run.dir=again")
    confusions = [results(run_folder)["confusion"]]
    for number, changes in enumerate(
        (
            ["data.test_rotation=so3", "seed=1"],
            ["representation=erp"],
            ["+representation.rotations=2"],
        )
    ):
        typed = [*ROOMS, rooms, *changes, f"hydra.run.dir={number}"]
        run("evaluate", _best(run_folder), *typed)
        confusion = results(Path(str(number)))["confusion"]
        assert confusion not in confusions
        confusions.append(confusion)


def test_classes_that_a_map_lacks_are_missed_or_never_win(
    network: str, rooms: str, run_folder: Path, tmp_path: Path, run: Run, capsys: Capture
) -> None:
    given = _written(tmp_path / "map.json", MAP)
    for unmapped in ("unknown", "never"):
        arguments = [network, *ROOMS, rooms, given, f"unmapped={unmapped}"]
        arguments += ["+representation.blend=nearest"]  # averages may change other classes, too
        run("evaluate", *arguments, f"hydra.run.dir={unmapped}")
    summary = "ceiling ← bright; floor ← dark; not predicted: beam, board, bookcase, chair, "
    assert summary in capsys.readouterr().out
    matrices = {name: _confusion(tmp_path / name) for name in ("unknown", "never")}
    floor, ceiling = (1 + CLASSES.index(name) for name in ("floor", "ceiling"))
    for name, matrix in matrices.items():
        truth = _confusion(run_folder).sum(axis=1)
        np.testing.assert_array_equal(matrix.sum(axis=1), truth)
        given_labels = {0, floor, ceiling} if name == "unknown" else {floor, ceiling}
        assert set(np.flatnonzero(matrix.sum(axis=0))) == given_labels
    unknown, never = matrices["unknown"], matrices["never"]
    assert (never[:, 1:] >= unknown[:, 1:]).all(), "pixels of green go to what is left"
    assert unknown[1:, 0].any()
    for page in ("report.html", "results.md"):
        text = (tmp_path / "never" / page).read_text()
        assert "photo.ckpt" in text
        assert "never win: green" in text
    content = json.loads((tmp_path / "never" / "results.json").read_text())
    assert content["checkpoint"] == network.partition("=")[2]
    assert content["label_map"] == str(tmp_path / "map.json")


def test_the_file_gives_the_views_that_are_not_typed(
    network: str, rooms: str, tmp_path: Path, run: Run
) -> None:
    given = _written(tmp_path / "map.json", MAP)
    typed = "level=3", "+representation.blend=feather"
    run("evaluate", network, *ROOMS, rooms, given, *typed, "hydra.run.dir=out")
    section = _config("out")["representation"]
    assert section == section | TANGENT | {"level": 3, "blend": "feather"}
    assert results(tmp_path / "out")["images"] == 2


def test_the_network_estimates_the_up_direction(
    network: str, rooms: str, run_folder: Path, tmp_path: Path, run: Run, monkeypatch: Patch
) -> None:
    """Asked in this process, once for every test panorama, before workers read them."""
    max_tilts: list[Any] = []

    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float, judge: Any) -> NDArray[np.float64]:
        likely = judge(np.eye(3))
        assert likely.shape == (3,)
        assert np.isfinite(likely).all()
        max_tilts.append(max_tilt_deg)
        return np.array([0.0, 0, -1])

    monkeypatch.setattr("datamodules.core.image_module.estimate_up", estimate)
    given = [*ROOMS, "data.upright=auto", "data.max_tilt_deg=180", "data.num_workers=1", rooms]
    mapped = _written(tmp_path / "map.json", MAP)
    run("evaluate", network, *given, mapped, "hydra.run.dir=imported")
    assert max_tilts == [180, 180]
    run("evaluate", _best(run_folder), *given, "hydra.run.dir=own")
    assert len(max_tilts) == 4
    assert (_confusion(tmp_path / "own") != _confusion(run_folder)).any(), "seen upside down"


@pytest.mark.parametrize("suffix", ["safetensors", "onnx"])
def test_an_exported_network_has_the_figures_of_its_run(
    suffix: str, rooms: str, run_folder: Path, tmp_path: Path, run: Run
) -> None:
    run("export", _best(run_folder), f"output=net.{suffix}")
    run("evaluate", f"checkpoint=net.{suffix}", *ROOMS, rooms, "hydra.run.dir=exported")
    expected = _confusion(run_folder)
    differing = np.abs(_confusion(tmp_path / "exported") - expected).sum()
    # onnxruntime rounds otherwise: a few pixels between two classes may change sides.
    assert differing <= (0 if suffix == "safetensors" else 0.01 * expected.sum())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"label_map": None}, r"found classes .*beam.*; expected .*dark.*label_map="),
        ({"unmapped": "unmapped=often"}, "unmapped: found often; expected 'unknown' or 'never'"),
        ({"task": "task=depth"}, "checkpoint: found a network that predicts pixel_classes"),
        ({"optimizer": "optimizer.lr=1"}, "optimizer.lr: found a value; .*does not read it"),
    ],
)
def test_impossible_evaluations_are_refused(
    changes: dict[str, Any], message: str, network: str, rooms: str, tmp_path: Path, run: Run
) -> None:
    given = {"checkpoint": network, "data": rooms, "label_map": MAP} | changes
    if given["label_map"]:
        given["label_map"] = _written(tmp_path / "map.json", given["label_map"])
    arguments = [*filter(None, given.values()), *(ROOMS if given["data"] == rooms else [])]
    with pytest.raises(SystemExit, match=message):
        run("evaluate", *arguments)


CONSISTENCY = {f"consistency_{name}_{turn}" for name in ("labels", "miou") for turn in TURNS}


def test_consistency_is_a_score_beside_the_others(
    run_folder: Path, rooms: str, tmp_path: Path, run: Run, capsys: Capture
) -> None:
    arguments = [_best(run_folder), *ROOMS, rooms, "consistency=2"]
    run("evaluate", *arguments, "hydra.run.dir=out")
    assert "equal labels under random rotations" in capsys.readouterr().out
    content, before = results(tmp_path / "out"), results(run_folder)
    for name in CONSISTENCY:
        assert 0 < content["scores"][name] <= 1
        low, high = content["intervals"].pop(name)
        assert low <= content["scores"].pop(name) <= high
        assert before["scores"].pop(name) is None
    assert content == before


def test_consistency_needs_no_labels(
    network: str, tmp_path: Path, run: Run, capsys: Capture
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for number in (1, 2):
        Image.fromarray(sphere(32 * number)).save(folder / f"{number}.png")
    run("evaluate", network, "input=in", "consistency=2", "hydra.run.dir=out")
    content = results(tmp_path / "out")
    assert content["scores"].keys() == content["columns"].keys() == CONSISTENCY
    assert content["intervals"].keys() == CONSISTENCY
    assert (content["images"], content["protocol"]["data"]) == (2, "in")
    assert min(content["scores"].values()) > 0.8, "smooth colors"
    assert "equal labels" in (tmp_path / "out" / "report.html").read_text()
    run("evaluate", network, "input=in", "consistency=2", "representation=erp", "hydra.run.dir=erp")
    assert results(tmp_path / "erp")["scores"] != content["scores"]
    capsys.readouterr()
    run("report", "out", "erp")
    assert "EquirectRepresentation" in capsys.readouterr().out
    given = _written(tmp_path / "map.json", MAP)
    run("evaluate", network, "input=in/1.png", "consistency=1", given, "hydra.run.dir=one")
    assert results(tmp_path / "one")["intervals"] == {}
    with pytest.raises(SystemExit, match="data: found a value; expected nothing: input= has no"):
        run("evaluate", network, "input=in", "data=synthrooms")
    with pytest.raises(SystemExit, match="consistency: found a value; expected nothing"):
        run("evaluate", "predictions=in", "data=synthrooms", "consistency=2")
    rgbd = write_checkpoint(tmp_path / "rgbd.ckpt", TANGENT, 4)
    with pytest.raises(SystemExit, match="found 'panoramas without depth'; expected 'panoramas'"):
        run("evaluate", f"checkpoint={rgbd}", "input=in")


def test_consistency_of_distances(tmp_path: Path, run: Run) -> None:
    write_depth_checkpoint(tmp_path / "depth.ckpt")
    Image.fromarray(sphere(32)).save(tmp_path / "one.png")
    run("evaluate", "checkpoint=depth.ckpt", "input=one.png", "consistency=2", "task=depth",
        "hydra.run.dir=out")  # fmt: skip
    scores = results(tmp_path / "out")["scores"]
    assert scores.keys() == {"consistency_distance_yaw", "consistency_distance_so3"}
    assert 0 < scores["consistency_distance_yaw"] < 0.2
