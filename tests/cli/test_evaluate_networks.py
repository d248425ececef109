"""`tangent-evaluate` of networks whose files know no run, and with label maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.stanford2d3ds.files import CLASSES
from tangent_train.checkpoints.content import read_settings
from tangent_train.config.build import build_from_config
from tests.cli.tiny_runs import SMALL_ROOMS, Run, results
from tests.inference.trained import ERP, TANGENT, write_checkpoint

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


def _written(path: Path, content: Any) -> str:
    path.write_text(json.dumps(content))
    return f"label_map={path}"


def _confusion(folder: Path) -> Any:
    return np.asarray(results(folder)["confusion"])


def test_classes_that_a_map_lacks_are_missed_or_never_win(
    network: str,
    rooms: str,
    run_folder: Path,
    tmp_path: Path,
    run: Run,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = _written(tmp_path / "my map.json", MAP)
    for unmapped in ("unknown", "never"):
        arguments = [network, *ROOMS, rooms, given, f"unmapped={unmapped}"]
        arguments += ["representation.blend=nearest"]  # averages may change other classes, too
        run("evaluate", *arguments, f"hydra.run.dir={unmapped}")
    summary = (
        "ceiling ← bright; floor ← dark; not predicted: beam, board, bookcase, chair, clutter, "
    )
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
    config = read_settings(tmp_path / "never" / "config.yaml")
    assert (config["label_map"], config["unmapped"]) == (str(tmp_path / "my map.json"), "never")
    assert config["network"]["_target_"] == "torch.nn.Conv2d"
    assert not {"network", "representation"} & config["choices"].keys(), "they are the file's"
    assert config["choices"]["data"] == "synthrooms"
    assert config["data"]["inputs"] == ["rgb"]
    assert config["level"] == config["representation"]["level"] == 4
    for page in ("report.html", "results.md"):
        text = (tmp_path / "never" / page).read_text()
        assert "photo.ckpt" in text
        assert "ceiling ← bright" in text
        assert "never win: green" in text
    content = json.loads((tmp_path / "never" / "results.json").read_text())
    assert content["checkpoint"] == network.partition("=")[2]
    assert content["label_map"] == str(tmp_path / "my map.json")
    assert len(list((tmp_path / "unknown" / "panels").glob("*.png"))) == 1


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        (["representation=erp"], ERP),
        (["level=3"], TANGENT | {"level": 3}),
        (
            ["representation.blend=feather", "representation.base_level=1"],
            TANGENT | {"base_level": 1, "blend": "feather"},
        ),
    ],
)
def test_the_file_gives_what_is_not_typed(
    typed: list[str], expected: dict[str, Any], network: str, rooms: str, tmp_path: Path, run: Run
) -> None:
    given = _written(tmp_path / "map.json", MAP)
    run("evaluate", network, *ROOMS, rooms, given, *typed, "hydra.run.dir=out")
    section = read_settings(tmp_path / "out" / "config.yaml")["representation"]
    assert section == section | expected
    assert results(tmp_path / "out")["images"] == 2


@pytest.mark.parametrize(
    ("typed", "views"),
    [
        ([], 40),
        (["level=4"], 20),
        (["representation.levels=4"], 20),
        (["representation.levels=3"], 20),
        (["representation.rotations=2"], 80),
        (["representation.base_level=1"], 160),
    ],
)
def test_the_levels_of_an_imported_network(
    typed: list[str], views: int, rooms: str, tmp_path: Path, run: Run
) -> None:
    """Those in the file, unless typed: one level halves the number of views."""
    section = TANGENT | {"levels": [4, 3], "dim": 16}
    network = write_checkpoint(tmp_path / "two.ckpt", section)
    given = _written(tmp_path / "map.json", MAP)
    run("evaluate", f"checkpoint={network}", *ROOMS, rooms, given, *typed, "hydra.run.dir=out")
    stored = read_settings(tmp_path / "out" / "config.yaml")["representation"]
    made: Any = build_from_config(stored, "representation")
    assert sum(map(len, made.view_sets())) == views


def test_the_network_estimates_the_up_direction(
    network: str,
    rooms: str,
    run_folder: Path,
    tmp_path: Path,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Asked in this process, once for every test panorama, before workers read them."""
    max_tilts: list[Any] = []

    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float, judge: Any) -> NDArray[np.float64]:
        likely = judge(np.eye(3))
        assert likely.shape == (3,)
        assert np.isfinite(likely).all()
        max_tilts.append(max_tilt_deg)
        return np.array([0.0, 0, -1])

    monkeypatch.setattr("datamodules.core.transforms.estimate_up", estimate)
    given = ["data.upright=auto", "data.max_tilt_deg=180", "data.num_workers=1", rooms]
    mapped = _written(tmp_path / "map.json", MAP)
    run("evaluate", network, *ROOMS, *given, mapped, "hydra.run.dir=imported")
    assert max_tilts == [180, 180]
    best = f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}"
    run("evaluate", best, *given, "trainer.accelerator=cpu", "hydra.run.dir=own")
    assert len(max_tilts) == 4
    assert (_confusion(tmp_path / "own") != _confusion(run_folder)).any(), "seen upside down"


@pytest.mark.parametrize("suffix", ["safetensors", "onnx"])
def test_an_exported_network_has_the_figures_of_its_run(
    suffix: str, rooms: str, run_folder: Path, tmp_path: Path, run: Run
) -> None:
    run("export", f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}", f"output=net.{suffix}")
    run("evaluate", f"checkpoint=net.{suffix}", *ROOMS, rooms, "hydra.run.dir=exported")
    assert results(tmp_path / "exported")["images"] == 2
    expected = _confusion(run_folder)
    differing = np.abs(_confusion(tmp_path / "exported") - expected).sum()
    # onnxruntime rounds otherwise: a few pixels between two classes may change sides.
    assert differing <= (0 if suffix == "safetensors" else 0.01 * expected.sum())
    assert f"net.{suffix}" in (tmp_path / "exported" / "report.html").read_text()


def test_a_label_map_of_a_run(rooms: str, run_folder: Path, tmp_path: Path, run: Run) -> None:
    """One that changes nothing but the order."""
    arguments = [f"checkpoint={run_folder / 'checkpoints' / 'best.ckpt'}", rooms]
    same = _written(tmp_path / "same.json", {"classes": {n: [n] for n in reversed(CLASSES)}})
    run("evaluate", *arguments, same, "trainer.accelerator=cpu", "hydra.run.dir=same")
    np.testing.assert_array_equal(_confusion(tmp_path / "same"), _confusion(run_folder))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data": None}, r"data: found none, and .*photo\.ckpt has no settings of a run.*data="),
        ({"label_map": None}, r"found class names .*'beam'.*; expected .*'dark'.*label_map="),
        ({"label_map": {"classes": {"floor": ["pink"]}}}, "found no class of the map in a network"),
        ({"network": "network.widths=[4]"}, r"network\.widths: found .*the network is in"),
        ({"inputs": "data.inputs=[rgb,depth]"}, "found inputs|normalization"),
        ({"unmapped": "unmapped=often"}, "unmapped: found often; expected unknown or never"),
        ({"data": "data=synthshapes"}, "task: found a head for pixel_classes"),
        ({"checkpoint": "checkpoint=none.onnx"}, r"none\.onnx: found no such file"),
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
