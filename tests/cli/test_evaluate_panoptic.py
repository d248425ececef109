"""`tangent-evaluate task=panoptic`: objects of a toy network against files of Stanford2D3DS."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchmetrics.detection import PanopticQuality

import tangent_train as tt
from datamodules.stanford2d3ds.files import CLASSES, MISSING_LABEL, THINGS
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.errors import SettingError
from tangent_train.io.pixel_files import write_pixels
from tangent_train.metrics.panoptic import LABEL
from tangent_train.photo_networks import PhotoNetwork, import_network
from tests.cli.test_predict_objects import NAMES, SETTINGS, SHAPE, TRUST, UNIT, Connected, scene
from tests.cli.tiny_runs import Run, results

TABLE = ["<UNK>_0_<UNK>_0_0", *(f"{n}_{k}_office_1_5" for n in NAMES for k in range(9))]
STARTS = {name: 1 + 9 * k for k, name in enumerate(NAMES)}
DATA = ("task=panoptic", "data=stanford2d3ds", "data.root=data", "data.inputs=[rgb]", "+data.areas=[1,5a]", "panels=2")
ERP_128 = ("level=6", "representation=tangent", "representation.base_level=0")
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
    write_pixels(folder / "semantic" / f"{stem}_semantic.png", colors)


@pytest.fixture
def truths(tmp_path: Path) -> list[NDArray[np.int64]]:
    """Toy codes of two test panoramas; the second one has other objects than its image shows."""
    rgb, codes = scene()
    other: Any = np.roll(codes, 3, axis=1)
    other[codes == 3 * LABEL + 2] = LABEL  # no table at the pole
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


def in_classes(codes: Any) -> NDArray[np.int64]:
    """Toy codes with the labels of the 13 classes, and 0 as the number of stuff."""
    labels = np.array([0, *(1 + CLASSES.index(name) for name in NAMES)])[codes // LABEL]
    return labels * LABEL + codes % LABEL


def expected_scores(pairs: list[tuple[Any, Any]]) -> NDArray[np.float64]:
    """PQ, SQ and RQ of wall, chair and table, of torchmetrics."""
    wall, *things = (1 + CLASSES.index(name) for name in NAMES)
    how: dict[str, Any] = {"return_sq_and_rq": True, "return_per_class": True}
    metric = PanopticQuality(set(things), {wall}, allow_unknown_preds_category=True, **how)
    for pair in pairs:
        maps = (np.stack([codes // LABEL, codes % LABEL], -1) for codes in pair)
        metric.update(*(torch.from_numpy(codes)[None] for codes in maps))
    found: NDArray[np.float64] = metric.compute().numpy()[[2, 0, 1]]
    return found


def test_scores_of_whole_panoramas_are_those_of_torchmetrics(
    truths: list[NDArray[np.int64]], tmp_path: Path, run: Run
) -> None:
    run("evaluate", "checkpoint=net.ckpt", *DATA, *ERP_128, *COMMON, "hydra.run.dir=out")
    content = results(tmp_path / "out")
    views = {"option": "tangent", "base_level": 0}
    loaded = tt.load("net.ckpt", label_map="map.json", levels=6, views=views, trust=TRUST)
    shift = {"wall": 12, "chair": 5, "table": 11}
    assert {name: 1 + CLASSES.index(name) for name in NAMES} == shift
    files = sorted(Path("data/area_5a/pano/rgb").iterdir())
    own = {label: 1 + CLASSES.index(name) for label, name in enumerate(loaded.class_names[1:], 1)}
    table = np.array([0, *own.values()])
    pairs = []
    for file, truth in zip(files, truths, strict=True):
        codes, _ = loaded.panoptic(file)
        codes = np.where((codes // LABEL > 1) & (codes % LABEL == 0), 0, codes)
        pairs.append((table[codes // LABEL] * LABEL + codes % LABEL, in_classes(truth)))
    per_class = {e["class"]: [e[n] for n in ("pq", "sq", "rq")] for e in content["classes"]}
    expected = expected_scores(pairs)
    assert np.array([per_class[name] for name in NAMES]) == pytest.approx(expected, abs=1e-6)
    means = [content["scores"][name] for name in ("pq", "sq", "rq")]
    assert means == pytest.approx(expected.mean(axis=0), abs=1e-6)
    assert 0.5 < means[0] < 0.95
    print(content["scores"], content["intervals"], content["protocol"])
