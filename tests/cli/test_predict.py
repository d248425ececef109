"""`tangent-predict` end to end on synthetic images."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from tangent_train.geometry import rotation_about
from tangent_train.inference.engine import Predictor, UpLikelihood
from tangent_train.inference.images import InputImage
from tangent_train.io.pixel_files import write_pixels
from tests.cli.tiny_runs import Predict, predicted
from tests.datamodules.data_files import read_png
from tests.inference.trained import ERP, PERSPECTIVE, sphere, write_checkpoint
from tests.rendering.drawn_room import draw_room
from tests.running import Capture, Patch


def test_a_folder_of_panoramas(tmp_path: Path, predict: Predict) -> None:
    """Several formats and sizes, and broken files."""
    folder = tmp_path / "panoramas"
    output = tmp_path / "out"
    write_pixels(folder / "ab.png", sphere(32))
    write_pixels(folder / "flat" / "küche #1.tif", sphere(50))
    write_pixels(folder / "flat" / "caf\udce9.webp", sphere(16))
    write_pixels(folder / "square.png", sphere(16)[:, :16])
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    for name in ("b.bmp", "c.gif"):
        Image.fromarray(sphere(32)).save(folder / name)
    (folder / "phone.HEIC").write_bytes(b"not decoded")
    with pytest.raises(SystemExit, match="3 of 8 images could not be used"):
        predict(input=folder, output=output)
    for name, height in {"ab": 32, "flat/küche #1": 50, "b": 32, "c": 32}.items():
        labels = read_png(output / "labels" / f"{name}.png")
        assert labels.shape == (height, 2 * height)
        assert labels.dtype == np.uint8
        assert set(np.unique(labels)) <= {1, 2, 3}
        for kind in ("color", "overlay"):
            assert read_png(output / kind / f"{name}.png").shape[1:] == (2 * height, 3)
    entries = predicted(output)
    assert len(entries) == 8
    assert all("found" in entries[name]["error"] for name in ("broken", "phone"))
    with (output / "summary.csv").open(newline="") as file:
        rows = {Path(row["file"]).name: row for row in csv.DictReader(file)}
    assert rows["broken.jpg"]["dark"] == rows["phone.HEIC"]["dark"] == ""
    assert rows["ab.png"]["dark"] == str(entries["ab"]["classes"]["dark"])
    names = json.loads((output / "classes.json").read_text())
    assert names == {"dark": [1], "green": [2], "bright": [3]}
    for remedy in ("16 × 16", "area=", "GPano", "projection=perspective"):
        assert remedy in entries["square"]["error"]
    assert sum(entries["ab"]["classes"].values()) == pytest.approx(1)
    page = (output / "report.html").read_text()
    assert "flat/küche #1" in page
    shares = [entry["classes"] for entry in entries.values() if "classes" in entry]
    means = sorted((np.mean([of[name] for of in shares]) for name in names), reverse=True)
    places = [page.index(f">{100 * mean:.1f}<") for mean in means]
    assert places == sorted(places), "the largest first"
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert not list(output.rglob(".partial*"))


def test_an_interruption_keeps_what_is_done(
    tmp_path: Path, predict: Predict, monkeypatch: Patch, capsys: Capture
) -> None:
    for name in ("a", "b", "c"):
        write_pixels(tmp_path / "in" / f"{name}.png", sphere(16))
    whole, names = Predictor.predict, iter("abc")

    def interrupted(*args: Any, **settings: Any) -> Any:
        if next(names) == "b":
            raise KeyboardInterrupt
        return whole(*args, **settings)

    monkeypatch.setattr(Predictor, "predict", interrupted)
    with pytest.raises(SystemExit) as stopped:
        predict()
    assert stopped.value.code == 130
    first = tmp_path / "out" / "labels" / "a.png"
    assert list(first.parent.iterdir()) == [first]
    monkeypatch.setattr(Predictor, "predict", whole)
    checkpoint = shutil.copy(tmp_path / "model.ckpt", tmp_path / "copy.ckpt")
    written = first.stat().st_mtime_ns
    with pytest.raises(SystemExit, match="blend: found nearest; expected feather, with which"):
        predict(blend="nearest")
    assert predict(checkpoint=checkpoint).keys() == {"a", "b", "c"}
    assert "3 images, 1 done already" in capsys.readouterr().out
    assert first.stat().st_mtime_ns == written
    write_checkpoint(Path(checkpoint), ERP)
    with pytest.raises(SystemExit, match="checkpoint: found SHA-256"):
        predict(checkpoint=checkpoint)
    # New images are added; results below the input are not taken for images.
    write_pixels(tmp_path / "in" / "d.png", sphere(16))
    assert predict().keys() == {"a", "b", "c", "d"}
    assert predict(output=tmp_path / "in" / "again").keys() == {"a", "b", "c", "d"}
    assert predict(output=tmp_path / "in" / "more").keys() == {"a", "b", "c", "d"}
    again = {"input": tmp_path / "in" / "**" / "*.png", "output": tmp_path / "in" / "again"}
    with pytest.raises(SystemExit, match=r"input: found .*; expected in, with which .*again"):
        predict(**again)
    again["output"] = tmp_path / "in" / "of_pattern"
    assert len(predict(**again)) == len(predict(**again)) == 4


def test_a_part_of_a_panorama_is_labeled_as_that_part(
    tmp_path: Path, predict: Predict, capsys: Capture
) -> None:
    """Away from its borders, across the seam, it gets what the whole panorama gets there."""
    rows, columns = np.arange(16, 48), np.r_[112:128, 0:16]
    whole, part = tmp_path / "whole.png", tmp_path / "part.png"
    write_pixels(whole, sphere(64))
    write_pixels(part, sphere(64)[rows][:, columns])
    common = {"blend": "nearest", "write": "[labels,probabilities]"}
    predict(**common, input=whole, output=tmp_path / "w")
    assert "A panorama is predicted in 20 views" in capsys.readouterr().out
    predict(**common, input=part, output=tmp_path / "p", area="[135,-135,-45,45]", fill="edge")
    assert "A panorama is predicted in 3 views" in capsys.readouterr().out
    assert json.loads((tmp_path / "p" / "summary.json").read_text())["fill"] == "edge"
    inner = slice(8, -8)
    for read in (
        lambda folder, name: read_png(folder / "labels" / f"{name}.png"),
        lambda folder, name: np.load(folder / "probabilities" / f"{name}.npy").argmax(-1),
    ):
        expected = read(tmp_path / "w", "whole")[rows][:, columns]
        found = read(tmp_path / "p", "part")
        assert found.shape == expected.shape
        assert (found == expected)[inner, inner].mean() > 0.98
    assert not (tmp_path / "p" / "color").exists(), "written only if wanted"


def test_photos_get_labels(tmp_path: Path, predict: Predict, capsys: Capture) -> None:
    checkpoint = write_checkpoint(tmp_path / "photos.ckpt", PERSPECTIVE)
    write_pixels(tmp_path / "in" / "a.png", sphere(64)[10:40, 20:70])
    settings = {"checkpoint": checkpoint, "projection": "perspective"}
    with pytest.raises(SystemExit, match="1 of 1 images"):
        predict(**settings)
    assert "Give fov=" in " ".join(capsys.readouterr().out.split())
    predict(**settings, fov=70, output="wide")
    assert read_png(tmp_path / "wide" / "labels" / "a.png").shape == (30, 50)


def test_scores_that_are_not_finite_are_counted_and_named(
    tmp_path: Path, predict: Predict, capsys: Capture
) -> None:
    file = torch.load(tmp_path / "model.ckpt")
    file["state_dict"]["network.bias"][1] = torch.inf
    torch.save(file, tmp_path / "overflow.ckpt")
    write_pixels(tmp_path / "in" / "a.png", sphere(32))
    entry = predict(checkpoint=tmp_path / "overflow.ckpt", write="[labels,probabilities]")["a"]
    assert not read_png(tmp_path / "out" / "labels" / "a.png").any()
    assert not np.load(tmp_path / "out" / "probabilities" / "a.npy").any()
    assert (entry["not_finite"], entry["classes"]["unknown"]) == (1, 1)
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("NaN or infinite in parts of 1 image: a") == 1


def test_the_network_estimates_the_up_direction(
    tmp_path: Path, predict: Predict, monkeypatch: Patch
) -> None:
    even = np.full(6, 1 / 6)
    monkeypatch.setattr("tangent_train.orientation.gravity.up_probabilities", lambda *_: even)
    tilt = rotation_about((1, 0, 0), math.radians(100))
    room = draw_room((128, 256), tilt)
    write_pixels(tmp_path / "in" / "a.png", room)

    def judge(self: UpLikelihood, image: InputImage, ups: NDArray[np.float64]) -> Any:
        np.testing.assert_array_equal(image.rgb, room)
        return 30 * ups @ tilt[:, 2]

    monkeypatch.setattr(UpLikelihood, "__call__", judge)
    found = predict(upright="auto", max_tilt_deg=180, write="[labels]", report=0)["a"]
    assert found["tilt_deg"] == pytest.approx(100, abs=0.5)


def test_depth_is_that_of_the_image_in_its_folder(tmp_path: Path, predict: Predict) -> None:
    """In meters or units, ``.npy`` or PNG, with ``_depth`` at the end or not."""
    depth, checkpoint = tmp_path / "depth", write_checkpoint(tmp_path / "d.ckpt", channels=4)
    for scene, meters in (("x", 0.5), ("y", 3.5), ("z", 3.5)):
        write_pixels(tmp_path / "in" / scene / "a.png", sphere(32))
        (depth / scene).mkdir(parents=True)
        np.save(depth / scene / "a.npy", np.full((32, 64), meters, np.float32))
    (depth / "z" / "a.npy").unlink()
    cv2.imwrite(str(depth / "z" / "a_depth.png"), np.full((32, 64), 3500, np.uint16))
    predict(checkpoint=checkpoint, depth=depth)
    near, far, same = (read_png(tmp_path / "out" / "labels" / scene / "a.png") for scene in "xyz")
    assert (near != far).any()
    np.testing.assert_array_equal(far, same)
    np.save(depth / "z" / "a.npy", np.full((32, 64), 1, np.float32))
    with pytest.raises(SystemExit, match="1 of 3 images"):
        predict(checkpoint=checkpoint, depth=depth, output="again")
    with pytest.raises(SystemExit, match="depth: found null; expected a folder"):
        predict(checkpoint=checkpoint, output="none")
    with pytest.raises(SystemExit, match=r"depth: .*nothing reads it"):
        predict(depth=depth, output="none")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"input": "nowhere"}, "nowhere"),
        ({"min_confidence": 70}, "min_confidence: found 70.* less than or equal to 1"),
        ({"fov": 70}, "fov: found 70.0; expected null: nothing reads it"),
        ({"projection": "perspective", "rotations": 2}, "rotations: found"),
        ({"label_map": "night"}, "label_map: found 'night'; expected 'ade20k_to_cityscapes'"),
    ],
)
def test_impossible_settings_are_refused_before_any_work(
    tmp_path: Path, predict: Predict, changes: dict[str, Any], message: str
) -> None:
    write_pixels(tmp_path / "in" / "a.png", sphere(16))
    with pytest.raises(SystemExit, match=message):
        predict(**changes)
    assert not (tmp_path / "out").exists()
