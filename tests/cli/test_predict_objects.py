"""`tangent-predict` with a network that returns objects: files, tables, report and Python."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn

import tangent_train as tt
from datamodules.core.inputs import Normalization
from models.segments import Segments
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions, lonlat_to_xyz
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tangent_train.metrics.panoptic import LABEL, panoptic_sums, quality
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.tiny_runs import Predict, Run
from tests.photo_networks import huggingface_networks as networks

SHAPE = (128, 256)
UNIT = Normalization([0, 0, 0], [1, 1, 1])
NAMES = ("wall", "chair", "table")

# Longitude, latitude and radius in degrees, and class: the largest first.
DISCS = [(0, 0, 50, 1), (10, 85, 20, 2), (180, 10, 15, 1), (100, -20, 9, 1), (135, -20, 8, 1)]


class Connected(nn.Module):
    """Chairs are red, tables blue; the connected parts of an image are objects."""

    def __init__(self, strength: float = 20.0) -> None:
        super().__init__()
        self.strength = nn.Parameter(torch.tensor(strength))

    def forward(self, images: Tensor) -> Any:
        red, _, blue = images.unbind(1)
        scores = torch.stack([1 - red - blue, red, blue], dim=1) * self.strength
        return {"out": scores, "segments": [self._segments(image) for image in scores.argmax(1)]}

    def _segments(self, labels: Tensor) -> Segments:
        numbers, classes = np.zeros(labels.shape, np.int32), list[int]()
        for label in (0, 1, 2):  # walls too, which are not things
            parts, count = ndimage.label(labels.numpy() == label)
            numbers[parts > 0] = parts[parts > 0] + len(classes)
            classes += [label] * count
        scores = torch.full((len(classes),), 0.9)
        return Segments(torch.from_numpy(numbers), torch.tensor(classes), scores)


SETTINGS = {"_target_": f"{__name__}.Connected"}
TRUST = f"{__name__}.Connected"


def scene() -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return an image and its panoptic map."""
    directions = equirect_directions(SHAPE)
    rgb, codes = np.zeros((*SHAPE, 3), np.uint8), np.full(SHAPE, LABEL)
    for number, (longitude, latitude, radius, label) in enumerate(DISCS, 1):
        center = lonlat_to_xyz(np.radians([longitude, latitude]))
        inside = directions @ center > np.cos(np.radians(radius))
        rgb[inside] = 0
        rgb[inside, 0 if label == 1 else 2] = 255
        codes[inside] = (label + 1) * LABEL + number
    return rgb, codes


@pytest.fixture
def network(tmp_path: Path) -> Path:
    photo = PhotoNetwork(Connected(), SETTINGS, NAMES, UNIT, (64, 64), things=NAMES[1:])
    import_network(photo, tmp_path / "net.ckpt")
    return tmp_path / "net.ckpt"


def test_objects_of_a_panorama(tmp_path: Path, network: Path, predict: Predict) -> None:
    rgb, truth = scene()
    write_pixels(tmp_path / "in" / "hall.png", rgb)
    kinds = "[panoptic,labels,objects,overlay]"
    distances = (1 + 0.5 * (truth % LABEL)).astype(np.float32)  # of each object another
    distances[::2] = np.nan
    (tmp_path / "distances").mkdir()
    np.save(tmp_path / "distances" / "hall.npy", distances)
    settings = {"write": kinds, "trust": f"[{TRUST}]", "depth": "distances"}
    entry = predict(checkpoint=network, **settings)["hall"]
    output = tmp_path / "out"
    colors = read_pixels(output / "panoptic" / "hall.png", indices=False).astype(int)
    codes = colors @ [1, 256, LABEL]
    scores = quality(panoptic_sums(codes, truth, 4)[1])
    np.testing.assert_array_equal(scores["rq"][0], 1)
    assert scores["pq"][0].min() > 0.9
    assert scores["rq"][1, 1] == scores["rq"][2, 2] == 1  # across the seam; over the pole
    labels = read_pixels(output / "labels" / "hall.png", indices=True)
    numbers = read_pixels(output / "objects" / "hall.png", indices=True)
    known = codes > 0  # else a chair or table without an object
    assert known.mean() > 0.99
    np.testing.assert_array_equal((labels.astype(int) * LABEL + numbers)[known], codes[known])
    assert numbers.dtype == np.uint16

    content = json.loads((output / "panoptic.json").read_text())
    (annotation,) = content["annotations"]
    segments = annotation["segments_info"]
    assert {s["id"]: s["area"] for s in segments} == dict(
        zip(*np.unique(codes[known], return_counts=True), strict=True)
    )
    assert [c["isthing"] for c in content["categories"]] == [0, 1, 1]
    rows = list(csv.DictReader((output / "objects.csv").read_text().splitlines()))
    assert [row["number"] for row in sorted(rows, key=lambda row: int(row["number"]))] == list(
        "12345"
    )
    of_number = {int(row["number"]): row for row in rows}
    for number, (longitude, latitude, radius, label) in enumerate(DISCS, 1):
        row = of_number[number]
        assert row["class"] == NAMES[label]
        center = np.radians([float(row["longitude_deg"]), float(row["latitude_deg"])])
        expected = lonlat_to_xyz(np.radians([longitude, latitude]))
        assert lonlat_to_xyz(center) @ expected > np.cos(np.radians(1.5))
        assert float(row["width_deg"]) == pytest.approx(2 * radius, abs=3)
        assert float(row["score"]) == pytest.approx(0.9)
        assert float(row["distance_m"]) == pytest.approx(1 + 0.5 * number, abs=0.002)
    assert entry["classes"]["wall"] < 1
    report = (output / "report.html").read_text()
    assert '"1":{"number":1,"class":"chair","score":0.9,' in report


def test_python_returns_labels_and_objects(network: Path) -> None:
    rgb, truth = scene()
    loaded = tt.load(network, trust=TRUST)
    codes, objects = loaded.panoptic(rgb, depth=np.full(SHAPE, 2.5))
    assert {each["distance_m"] for each in objects} == {2.5}
    assert [each["class"] for each in objects] == [NAMES[disc[3]] for disc in DISCS]
    labels = loaded.labels(rgb)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, codes // LABEL)
    assert (codes == truth).mean() > 0.95
    codes, objects = loaded.panoptic(rgb[:64, 100:180], fov=70)
    assert {each["class"] for each in objects} == {"chair", "table"}


def test_networks_without_objects_are_refused(tmp_path: Path) -> None:
    photo = PhotoNetwork(Connected(), SETTINGS, NAMES, UNIT, (64, 64))
    import_network(photo, tmp_path / "net.ckpt")
    with pytest.raises(SettingError, match="one without objects"):
        tt.load(tmp_path / "net.ckpt", trust=TRUST).panoptic(scene()[0])


@pytest.mark.parametrize("made", [networks.maskformer, networks.oneformer])
def test_universal_networks_of_the_library(
    tmp_path: Path, run: Run, predict: Predict, made: Callable[[], Any]
) -> None:
    def sure_of_floors() -> networks.Made:
        network, processor = made()
        (bias,) = (p for p in network.parameters() if p.shape == (len(networks.NAMES) + 1,))
        bias.data[1] += 5
        return network, processor

    networks.tokenizer(tmp_path / "net")
    networks.saved(sure_of_floors, tmp_path / "net")
    run("import", "library=huggingface", "model=net", "things=[floor,car]", "output=net.ckpt")
    rgb = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    write_pixels(tmp_path / "in" / "hall.png", rgb)
    predict(checkpoint="net.ckpt", write="[panoptic,objects]")
    rows = list(csv.DictReader((tmp_path / "out" / "objects.csv").read_text().splitlines()))
    numbers = read_pixels(tmp_path / "out" / "objects" / "hall.png", indices=True)
    assert rows
    assert {int(row["number"]) for row in rows} == set(np.unique(numbers[numbers > 0]).tolist())
    assert {row["class"] for row in rows} == {"floor"}
    assert all(0.5 < float(row["score"]) <= 1 for row in rows)
    assert '"1":{"number":1,"class":"floor",' in (tmp_path / "out" / "report.html").read_text()
