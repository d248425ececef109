"""`tangent-predict` end to end on pictures made here."""

from __future__ import annotations

import csv
import json
import sys
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from PIL import Image

from tangent_train.cli import main
from tangent_train.geometry import equirect_directions, equirect_solid_angles
from tangent_train.inference.images import read_panorama
from tests.inference.trained import CLASS_NAMES, PERSPECTIVE, TANGENT, write_checkpoint

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "models" / "best.ckpt")


def _predict(monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
    arguments = [f"{name}={value}" for name, value in settings.items()]
    monkeypatch.setattr(sys, "argv", ["tangent-predict", *arguments])
    main.predict()


def _sphere(height: int) -> NDArray[np.uint8]:
    x, y, z = np.moveaxis(equirect_directions((height, 2 * height)), -1, 0)
    return np.stack([128 + 120 * x, 128 + 120 * y * z, 128 + 120 * z], axis=-1).astype(np.uint8)


def _write(path: Path, rgb: NDArray[np.uint8]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return path


def _labels(path: Path) -> NDArray[np.uint8]:
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert labels is not None
    assert labels.dtype == np.uint8
    assert labels.ndim == 2
    return labels


def test_a_folder_of_panoramas(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path
) -> None:
    """Names that command lines and shells dislike, several formats and sizes, one broken file."""
    folder, output = tmp_path / "my, panoramas (2)", tmp_path / "out='1'"
    _write(folder / "a=b.png", _sphere(32))
    _write(folder / "flat" / "küche #1.tif", _sphere(50))
    _write(folder / "flat" / "b.webp", _sphere(16))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    with pytest.raises(SystemExit, match="1 of 4 images could not be used"):
        _predict(monkeypatch, checkpoint=checkpoint, input=folder, output=output)
    names = {"a=b": 32, "flat/küche #1": 50, "flat/b": 16}
    for name, height in names.items():
        labels = _labels(output / "labels" / f"{name}.png")
        assert labels.shape == (height, 2 * height)
        assert set(np.unique(labels)) <= {1, 2, 3}
        color = cv2.imread(str(output / "color" / f"{name}.png"))
        assert color is not None
        assert color.shape == (height, 2 * height, 3)
        assert (output / "overlay" / f"{name}.png").is_file()
    summary = json.loads((output / "summary.json").read_text())
    entries = {entry["name"]: entry for entry in summary["images"]}
    assert set(entries) == {*names, "broken"}
    assert "found" in entries["broken"]["error"]
    labels = _labels(output / "labels" / "a=b.png")
    weights = np.repeat(equirect_solid_angles((32, 64))[:, None], 64, axis=1)
    for value, name in enumerate(CLASS_NAMES[1:], start=1):
        share = weights[labels == value].sum() / weights.sum()
        assert entries["a=b"]["classes"][name] == pytest.approx(share)
    assert json.loads((output / "classes.json").read_text()) == {"dark": 1, "green": 2, "bright": 3}
    with (output / "summary.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 4
    page = (output / "report.html").read_text()
    assert "flat/küche #1" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert not list(output.rglob(".partial*"))


def test_earlier_results_stay_unless_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path
) -> None:
    image = _write(tmp_path / "a.png", _sphere(16))
    settings = {"checkpoint": checkpoint, "input": image, "output": tmp_path / "out"}
    _predict(monkeypatch, **settings)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*.png")}
    with pytest.raises(SystemExit, match="overwrite=true"):
        _predict(monkeypatch, **settings)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    _predict(monkeypatch, **settings, overwrite="true", report=0)
    assert {path: path.stat().st_mtime_ns for path in before} != before


def test_probabilities_agree_with_the_labels(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path
) -> None:
    _write(tmp_path / "a.png", _sphere(24))
    output = tmp_path / "out"
    _predict(
        monkeypatch,
        checkpoint=checkpoint,
        input=tmp_path / "*.png",
        output=output,
        probabilities="true",
        rotations=2,
    )
    probabilities = np.load(output / "probabilities" / "a.npy", allow_pickle=False)
    assert probabilities.dtype == np.float16
    assert probabilities.shape == (24, 48, 3)
    np.testing.assert_allclose(probabilities.sum(axis=-1, dtype=np.float32), 1, atol=2e-3)
    best = np.sort(probabilities, axis=-1)
    decided = best[..., 2] - best[..., 1] > 0.01
    labels = _labels(output / "labels" / "a.png")
    assert (probabilities.argmax(axis=-1) + 1 == labels)[decided].all()


@pytest.mark.parametrize("crop", ["[135,-135,-45,45]", "[-90,90,0,90]"])
def test_a_part_of_a_panorama_is_labelled_as_that_part(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path, crop: str
) -> None:
    """Away from its borders it gets the labels that it has in the whole panorama."""
    west, east, south, north = json.loads(crop)
    whole = _sphere(64)
    columns = np.arange(round((west + 180) / 360 * 128), round((east + 180) / 360 * 128))
    if east < west:
        columns = np.r_[round((west + 180) / 360 * 128) : 128, 0 : round((east + 180) / 360 * 128)]
    rows = np.arange(round((90 - north) / 180 * 64), round((90 - south) / 180 * 64))
    _write(tmp_path / "whole" / "a.png", whole)
    part = np.ascontiguousarray(whole[rows][:, columns])
    _write(tmp_path / "part" / "a.png", part)
    common = {"checkpoint": checkpoint, "blend": "nearest"}
    _predict(monkeypatch, **common, input=tmp_path / "whole", output=tmp_path / "w")
    _predict(monkeypatch, **common, input=tmp_path / "part", output=tmp_path / "p", crop=crop)
    expected = _labels(tmp_path / "w" / "labels" / "a.png")[rows][:, columns]
    labels = _labels(tmp_path / "p" / "labels" / "a.png")
    assert labels.shape == part.shape[:2]
    inner = slice(8, -8)
    assert (labels == expected)[inner, inner].mean() > 0.98
    entry = json.loads((tmp_path / "p" / "summary.json").read_text())["images"][0]
    assert sum(entry["classes"].values()) == pytest.approx(1)


@pytest.mark.parametrize("representation", [TANGENT, PERSPECTIVE])
def test_photos(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    representation: dict[str, Any],
) -> None:
    checkpoint = write_checkpoint(tmp_path / "model.ckpt", representation)
    rgb = _sphere(64)[10:40, 20:70]
    _write(tmp_path / "photos" / "a.png", np.ascontiguousarray(rgb))
    settings = {"checkpoint": checkpoint, "input": tmp_path / "photos", "projection": "perspective"}
    with pytest.raises(SystemExit, match="1 of 1 images"):
        _predict(monkeypatch, **settings, output=tmp_path / "out")
    assert not (tmp_path / "out").exists()  # nothing in the way of the next try
    assert "Give fov=" in " ".join(capsys.readouterr().out.split())
    _predict(monkeypatch, **settings, output=tmp_path / "out", fov=70)
    assert _labels(tmp_path / "out" / "labels" / "a.png").shape == (30, 50)


def test_networks_with_depth_want_depth(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    checkpoint = write_checkpoint(tmp_path / "model.ckpt", channels=4)
    _write(tmp_path / "panoramas" / "a.png", _sphere(32))
    settings = {"checkpoint": checkpoint, "input": tmp_path / "panoramas"}
    with pytest.raises(SystemExit, match="depth: found none; expected a folder"):
        _predict(monkeypatch, **settings, output=tmp_path / "out")
    (tmp_path / "depth").mkdir()
    with pytest.raises(SystemExit, match="1 of 1 images"):
        _predict(monkeypatch, **settings, output=tmp_path / "out", depth=tmp_path / "depth")
    metres = np.linspace(0.5, 5, 32 * 64, dtype=np.float32).reshape(32, 64)
    np.save(tmp_path / "depth" / "a.npy", metres)
    millimetres = tmp_path / "millimetres"
    millimetres.mkdir()
    cv2.imwrite(str(millimetres / "a_depth.png"), np.rint(metres * 1000).astype(np.uint16))
    found = []
    for name, folder in (("npy", tmp_path / "depth"), ("png", millimetres)):
        _predict(monkeypatch, **settings, output=tmp_path / name, depth=folder)
        found.append(_labels(tmp_path / name / "labels" / "a.png"))
    assert (found[0] == found[1]).mean() > 0.99
    np.save(tmp_path / "depth" / "a.npy", np.full((32, 64), 0.5, np.float32))
    _predict(monkeypatch, **settings, output=tmp_path / "near", depth=tmp_path / "depth")
    assert (_labels(tmp_path / "near" / "labels" / "a.png") != found[0]).any()
    rgb_only = write_checkpoint(tmp_path / "rgb.ckpt")
    settings["checkpoint"] = rgb_only
    with pytest.raises(SystemExit, match=r"depth: .*expected null.*takes rgb\."):
        _predict(monkeypatch, **settings, output=tmp_path / "x", depth=tmp_path / "depth")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"checkpoint": "null"}, "checkpoint: found none"),
        ({"input": "nowhere"}, "nowhere"),
        ({"checkpoint": "nowhere.ckpt"}, r"nowhere\.ckpt: found no such file"),
        ({"blend": "mean"}, "blend: found mean; expected feather or nearest"),
        ({"base_level": 9}, "base_level"),
        ({"device": "abacus"}, "device"),
        ({"colour": 1}, "unknown setting"),
        ({"overwrite": "no"}, "overwrite: found no; expected true or false"),
        ({"images_per_forward": 1.5}, "images_per_forward: found 1.5; expected a whole number"),
        ({"crop": "[a,b,c,d]"}, "crop"),
    ],
)
def test_impossible_settings_are_refused_before_any_work(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    checkpoint: Path,
    changes: dict[str, Any],
    message: str,
) -> None:
    image = _write(tmp_path / "a.png", _sphere(16))
    settings = {"checkpoint": checkpoint, "input": image, "output": tmp_path / "out"}
    with pytest.raises(SystemExit, match=message):
        _predict(monkeypatch, **(settings | changes))
    assert not (tmp_path / "out").exists()


def test_an_interruption_keeps_what_is_done(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    checkpoint: Path,
) -> None:
    for name in ("a", "b", "c"):
        _write(tmp_path / "panoramas" / f"{name}.png", _sphere(16))

    def interrupted(path: Path, *args: Any) -> Any:
        if path.name == "b.png":
            raise KeyboardInterrupt
        return read_panorama(path, *args)

    monkeypatch.setattr("tangent_train.cli.predict.read_panorama", interrupted)
    output = tmp_path / "out"
    with pytest.raises(SystemExit) as stopped:
        _predict(monkeypatch, checkpoint=checkpoint, input=tmp_path / "panoramas", output=output)
    assert stopped.value.code == 130
    images = json.loads((output / "summary.json").read_text())["images"]
    assert [entry["name"] for entry in images] == ["a"]
    assert [path.name for path in (output / "labels").iterdir()] == ["a.png"]
    assert "1 of 3 images are done. resume=true" in capsys.readouterr().out
    monkeypatch.setattr("tangent_train.cli.predict.read_panorama", read_panorama)
    first = (output / "labels" / "a.png").stat().st_mtime_ns
    settings = {"checkpoint": checkpoint, "input": tmp_path / "panoramas", "output": output}
    with pytest.raises(SystemExit, match="resume: found blend=nearest, another setting"):
        _predict(monkeypatch, **settings, resume="true", blend="nearest")
    _predict(monkeypatch, **settings, resume="true")
    images = json.loads((output / "summary.json").read_text())["images"]
    assert [entry["name"] for entry in images] == ["a", "b", "c"]
    assert (output / "labels" / "a.png").stat().st_mtime_ns == first
    assert len(list((output / "labels").iterdir())) == 3


def test_results_are_not_labelled_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path
) -> None:
    _write(tmp_path / "a.png", _sphere(16))
    settings = {"checkpoint": checkpoint, "input": tmp_path, "output": tmp_path}
    for overwrite in ("false", "true"):
        _predict(monkeypatch, **settings, overwrite=overwrite, report=0)
        images = json.loads((tmp_path / "summary.json").read_text())["images"]
        assert [entry["name"] for entry in images] == ["a"]
    with pytest.raises(SystemExit, match="found only results"):
        _predict(monkeypatch, **(settings | {"input": tmp_path / "color"}), overwrite="true")


def test_one_picture_that_cannot_be_used_does_not_stop_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkpoint: Path
) -> None:
    """Neither a setting that does not fit it, nor a lie about its size, nor its name."""
    folder, output = tmp_path / "in", tmp_path / "out"
    _write(folder / "b.png", _sphere(16))
    _write(folder / "square.png", _sphere(16)[:, :16])
    strange = folder / "caf\udce9 ${x}.png"
    _write(folder / "c.png", _sphere(16)).rename(strange)
    lie = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="2000000" '
        'GPano:FullPanoHeightPixels="1000000" GPano:CroppedAreaImageWidthPixels="32" '
        'GPano:CroppedAreaImageHeightPixels="16" GPano:CroppedAreaLeftPixels="0" '
        'GPano:CroppedAreaTopPixels="0"/></rdf:RDF></x:xmpmeta>'
    )
    Image.fromarray(_sphere(16)).save(folder / "huge.webp", xmp=lie.encode())
    with pytest.raises(SystemExit, match="2 of 4 images"):
        _predict(monkeypatch, checkpoint=checkpoint, input=folder, output=output)
    assert len(list((output / "labels").iterdir())) == 2
    with (output / "summary.csv").open(newline="") as file:
        errors = {row["file"].rpartition("/")[2]: row["error"] for row in csv.DictReader(file)}
    assert "at most 32768" in errors["huge.webp"]
    assert "twice as wide" in errors["square.png"]


def test_depth_is_that_of_the_image_in_its_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    checkpoint = write_checkpoint(tmp_path / "model.ckpt", channels=4)
    for scene, metres in (("x", 0.5), ("y", 3.5)):
        _write(tmp_path / "images" / scene / "a.png", _sphere(32))
        (tmp_path / "depth" / scene).mkdir(parents=True)
        np.save(tmp_path / "depth" / scene / "a.npy", np.full((32, 64), metres, np.float32))
    settings = {"checkpoint": checkpoint, "input": tmp_path / "images", "output": tmp_path / "out"}
    _predict(monkeypatch, **settings, depth=tmp_path / "depth")
    near, far = (_labels(tmp_path / "out" / "labels" / scene / "a.png") for scene in "xy")
    assert (near != far).any()
    np.save(tmp_path / "depth" / "y" / "a_depth.npy", np.full((32, 64), 1, np.float32))
    with pytest.raises(SystemExit, match="1 of 2 images"):
        _predict(monkeypatch, **settings, depth=tmp_path / "depth", overwrite="true")
