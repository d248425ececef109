"""`tangent-evaluate task=panoptic`: objects of a toy network against files of Stanford2D3DS."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics.detection import PanopticQuality

from datamodules import structured3d
from datamodules.stanford2d3ds.files import CLASSES, MISSING_LABEL, THINGS
from tangent_train.io.pixel_files import write_pixels
from tangent_train.metrics.collected import PanopticMetric
from tangent_train.metrics.panoptic import LABEL
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.test_predict_objects import NAMES, SETTINGS, TRUST, UNIT, Connected, scene
from tests.cli.tiny_runs import Run, results

TABLE = ["<UNK>_0_<UNK>_0_0", *(f"{n}_{k}_office_1_5" for n in NAMES for k in range(9))]
STARTS = {name: 1 + 9 * k for k, name in enumerate(NAMES)}
DATA = ("task=panoptic", "data=stanford2d3ds", "data.root=data", "+data.areas=['1','5a']")
VIEWS = ("level=6", "representation=tangent", "representation.base_level=0")
SCORES = ("pq", "sq", "rq")
COMMON = ("label_map=map.json", f"trust=[{TRUST}]", "logger=none", "trainer.accelerator=cpu")


def write_panorama(root: Path, area: str, number: int, rgb: Any, codes: Any) -> None:
    """Write a panorama whose toy codes are ``number + 65536 label``; 0 is unknown."""
    stem = f"camera_{number:032x}_office_1_frame_equirectangular_domain"
    index = np.full(codes.shape, MISSING_LABEL)
    for label, name in enumerate(NAMES, 1):
        of_class = codes // LABEL == label
        index[of_class] = STARTS[name] + codes[of_class] % LABEL
    colors = np.stack([index >> shift & 255 for shift in (16, 8, 0)], -1).astype(np.uint8)
    folder = root / f"area_{area}" / "pano"
    write_pixels(folder / "rgb" / f"{stem}_rgb.png", rgb)
    write_pixels(folder / "depth" / f"{stem}_depth.png", np.ones(codes.shape, np.uint16))
    write_pixels(folder / "semantic" / f"{stem}_semantic.png", colors)


@pytest.fixture
def truths(tmp_path: Path) -> list[NDArray[np.int64]]:
    """Toy codes of two test panoramas; the second one has other objects than its image shows."""
    rgb, codes = scene()
    other: Any = np.roll(codes, 3, axis=1)
    other[other == 3 * LABEL + 2] = LABEL  # no table at the pole
    other[60:66, 40:60] = 3 * LABEL + 7
    other[:, 130:140] = 0
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "semantic_labels.json").write_text(json.dumps(TABLE))
    (tmp_path / "map.json").write_text(json.dumps({name: name for name in NAMES}))
    write_panorama(tmp_path / "data", "1", 0, rgb, codes)
    write_panorama(tmp_path / "data", "5a", 1, rgb, codes)
    write_panorama(tmp_path / "data", "5a", 2, np.roll(rgb, 40, axis=1), np.roll(other, 40, axis=1))
    photo = PhotoNetwork(Connected(), SETTINGS, NAMES, UNIT, (64, 64), things=NAMES[1:])
    import_network(photo, tmp_path / "net.ckpt")
    return [codes, np.roll(other, 40, axis=1)]


def expected_scores(pairs: list[tuple[Any, Any]]) -> NDArray[np.float64]:
    """PQ, SQ and RQ of wall, chair and table, of torchmetrics.

    Predicted unknown pixels are a class: torchmetrics leaves them out of the union, COCO does not.
    """
    wall, *things = (1 + CLASSES.index(name) for name in NAMES)
    how: dict[str, Any] = {"return_sq_and_rq": True, "return_per_class": True}
    metric = PanopticQuality(set(things), {wall, 99}, **how)
    for prediction, truth in pairs:
        pair = np.where(prediction == 0, 99 * LABEL, prediction), truth
        maps = (np.stack([codes // LABEL, codes % LABEL], -1) for codes in pair)
        metric.update(*(torch.from_numpy(codes)[None] for codes in maps))
    found: NDArray[np.float64] = metric.compute().numpy()[[2, 0, 1]]
    return found


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any]]:
    """Predicted and true maps that the metric gets."""
    pairs: list[tuple[Any, Any]] = []
    update = PanopticMetric.update

    def recorded(self: Any, prediction: Tensor, truth: Tensor) -> None:
        pairs.append((prediction.numpy(), truth.numpy()))
        update(self, prediction, truth)

    monkeypatch.setattr(PanopticMetric, "update", recorded)
    return pairs


def check(folder: Path, pairs: list[tuple[Any, Any]], truths: list[NDArray[np.int64]]) -> Any:
    """Compare the results in a folder with torchmetrics; return their scores."""
    for (_, truth), codes in zip(pairs, truths, strict=True):
        expected = codes.copy()
        for label, name in enumerate(NAMES, 1):
            of_class = codes // LABEL == label
            number = (STARTS[name] + codes % LABEL) * (name in THINGS)
            expected[of_class] = ((1 + CLASSES.index(name)) * LABEL + number)[of_class]
        np.testing.assert_array_equal(truth, expected)
    content = results(folder)
    per_class = {e["class"]: [e[name] for name in SCORES] for e in content["classes"]}
    numbers = expected_scores(pairs)
    assert np.array([per_class[name] for name in NAMES]) == pytest.approx(numbers)
    scores = content["scores"]
    assert [scores[name] for name in SCORES] == pytest.approx(numbers.mean(axis=0))
    assert scores["pq_things"] == pytest.approx(numbers[1:, 0].mean())
    return scores


def test_scores_are_those_of_torchmetrics(
    truths: list[NDArray[np.int64]], compared: list[Any], tmp_path: Path, run: Run
) -> None:
    run("evaluate", "checkpoint=net.ckpt", *DATA, *VIEWS, *COMMON, "panels=0", "hydra.run.dir=out")
    scores = check(tmp_path / "out", compared, truths)
    assert 0.5 < scores["pq"] < 0.9
    # One chair across the seam; the table at the pole, also there, is only in one of the truths.
    assert scores["pq_seam"] == pytest.approx((1 + 2 / 3) / 2, abs=0.01)
    assert scores["pq_poles"] == pytest.approx(2 / 3, abs=0.01)
    content = results(tmp_path / "out")
    assert content["intervals"].keys() >= {"pq", "rq_solid_angle", "pq_seam"}
    assert content["protocol"]["things"] == ", ".join(THINGS)
    with np.load(tmp_path / "out" / "results.npz") as sums:
        assert sums["things"].shape == (2, 2, 3, 9, 4)


def test_a_perfect_network_and_its_files(
    truths: list[NDArray[np.int64]], compared: list[Any], tmp_path: Path, run: Run
) -> None:
    """The first panorama is what its image shows; the bound is the sampling of the views."""
    for file in (tmp_path / "data" / "area_5a" / "pano").glob(f"*/camera_{2:032x}*"):
        file.unlink()
    run("evaluate", "checkpoint=net.ckpt", *DATA, *VIEWS, *COMMON, "panels=1", "hydra.run.dir=out")
    pairs = [compared[0]]  # the second one is for the picture
    scores = check(tmp_path / "out", pairs, truths[:1])
    assert scores["rq"] == scores["rq_solid_angle"] == 1
    assert scores["pq"] > 0.97
    assert min(scores["pq_seam"], scores["pq_poles"]) > 0.97
    report = (tmp_path / "out" / "report.html").read_text()
    assert "PQ of objects across ±180°" in report
    assert len(list((tmp_path / "out" / "panels").iterdir())) == 1
    run("report", "out")
    assert "PQ" in (tmp_path / "report" / "report.md").read_text()


def test_objects_of_structured3d(tmp_path: Path, run: Run) -> None:
    """A perfect network; furniture is numbered from 0 in a file of its own."""
    rgb, codes = scene()
    values = np.array([0, *(structured3d.CLASSES.index(name) + 1 for name in NAMES)], np.uint8)
    labels = values[codes // LABEL]
    numbers = np.where(codes // LABEL == 1, 65535, codes % LABEL - 1).astype(np.uint16)
    for number in (0, 3000, 3250):
        room = (
            tmp_path / "data" / f"scene_{number:05d}" / "2D_rendering" / "7" / "panorama" / "full"
        )
        files: dict[str, NDArray[Any]] = {"rgb_rawlight": rgb, "semantic": labels}
        files["instance"] = numbers
        for name, pixels in files.items():
            write_pixels(room / f"{name}.png", pixels)
    (tmp_path / "map.json").write_text(json.dumps({name: name for name in NAMES}))
    photo = PhotoNetwork(Connected(), SETTINGS, NAMES, UNIT, (64, 64), things=NAMES[1:])
    import_network(photo, tmp_path / "net.ckpt")
    data = "task=panoptic", "data=structured3d", "data.root=data"
    given = "checkpoint=net.ckpt", *data, *VIEWS, *COMMON, "panels=0", "hydra.run.dir=out"
    run("evaluate", *given)
    scores = results(tmp_path / "out")["scores"]
    assert scores["rq"] == 1
    assert min(scores["pq"], scores["pq_seam"], scores["pq_poles"]) > 0.97


def test_files_of_predictions(
    truths: list[NDArray[np.int64]], compared: list[Any], tmp_path: Path, run: Run
) -> None:
    given = (
        "checkpoint=net.ckpt",
        "input=data/area_5a/pano/rgb",
        "output=maps",
        "write=[panoptic]",
    )
    run("predict", *given, *COMMON[:2])
    run("evaluate", "predictions=maps", *DATA, "panels=0", "hydra.run.dir=out")
    check(tmp_path / "out", compared[::5], truths)  # four of each are of usual mistakes


@pytest.mark.parametrize(
    ("command", "changes", "message"),
    [
        ("train", ["data=synthrooms"], "task: found panoptic; expected task=segmentation: objects"),
        (
            "evaluate",
            ["data=synthrooms_perspective", "representation=perspective"],
            "data.labels: found panoptic; expected pixel_classes: the label files do not number",
        ),
        ("evaluate", ["data=synthrooms"], "checkpoint: found a network without objects"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(
    command: str, changes: list[str], message: str, tmp_path: Path, run: Run
) -> None:
    photo = PhotoNetwork(Connected(), SETTINGS, NAMES, UNIT, (64, 64))
    import_network(photo, tmp_path / "net.ckpt")
    (tmp_path / "map.json").write_text(json.dumps({name: name for name in NAMES}))
    typed = ["checkpoint=net.ckpt", *COMMON[:2]] * (command == "evaluate")
    with pytest.raises(SystemExit, match=message):
        run(command, "task=panoptic", *typed, *changes)
