"""``tangent-check``: shares of the classes, and what makes them doubtful."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tangent_train.cli.check import check
from tangent_train.cli.prepare import prepare
from tangent_train.io import pixel_files
from tangent_train.io.pixel_files import write_pixels
from tests.datamodules.data_files import save_tagged, write_png
from tests.datamodules.folder.folder_format import save, write_classes
from tests.running import Capture, composed_settings


def _checked(root: Path, capsys: Capture, *changes: str) -> tuple[str, str]:
    settings = ["data=folder", "level=4", f"data.root='{root}'", "data.val_fraction=0"]
    check(composed_settings("check", *settings, *changes))
    return capsys.readouterr()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Rows of labels 0 to 4, eight of each but 1; the test has no 4."""
    for name in ("a", "b", "test"):
        labels = np.repeat(np.array([0, 2, 3, 4 if name != "test" else 3], np.uint8), 8)
        rgb = np.zeros((32, 64, 3), np.uint8)
        save(tmp_path / "images" / f"{name}.png", rgb)
        save(tmp_path / "labels" / f"{name}.png", np.tile(labels[:, None], (1, 64)))
    (tmp_path / "test.txt").write_text("test")
    return tmp_path


def test_shares_and_classes_that_do_not_occur(root: Path, capsys: Capture) -> None:
    write_classes(root, [None, "door", "wall", "floor", "sofa"])
    out, err = _checked(root, capsys)
    assert out == "", "problems alone"
    rows = [line.split() for line in err.splitlines()]
    shares = {words[1]: words[3::2] for words in rows if words[:1] == ["│"]}
    assert shares == {
        "unknown": ["25.0", "25.0"],
        "door": ["0.0", "0.0"],
        "wall": ["25.0", "25.0"],
        "floor": ["25.0", "50.0"],
        "sofa": ["25.0", "0.0"],
    }
    warnings = [line for line in err.splitlines() if line.startswith("Warning: ")]
    assert warnings == [
        "Warning: Classes without a pixel for train: door (1 of 4).",
        "Warning: Classes without a pixel for test: door, sofa (2 of 4).",
    ]
    assert "0 problems and 2 warnings; 3 panoramas of" in err


def test_stereo_panoramas_are_among_the_problems(root: Path, capsys: Capture) -> None:
    """One picture with two halves of 180°, as its tags say, has the size of a panorama."""
    (root / "images" / "b.png").unlink()
    save_tagged(root / "images" / "b.jpg", {"StereoMode": "left-right"}, (32, 64))
    write_classes(root, [None, "door", "wall", "floor", "sofa"])
    with pytest.raises(SystemExit) as ended:
        _checked(root, capsys)
    assert ended.value.code
    out = " ".join(capsys.readouterr().out.split())
    assert "b.jpg a stereo panorama (left-right), by its metadata" in out


def test_colors_of_12_bits_are_among_the_warnings(
    root: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pixel_files, "_has_warned", bytearray(1))
    monkeypatch.setenv("COLUMNS", "300")
    write_pixels(root / "images" / "a.png", np.full((32, 64, 3), 4095, np.uint16))
    classes = [None, "door", "wall", "floor", "sofa"]
    write_classes(root, classes)
    _out, err = _checked(root, capsys, "data.num_workers=0")
    assert "a.png: the largest value of 16-bit colors is 4095" in err
    assert "0 problems and 3 warnings; 3 panoramas of" in err


def test_nothing_is_wrong(root: Path, capsys: Capture) -> None:
    write_classes(root, [None, None, "wall", "floor", None])
    out, err = _checked(root, capsys)
    assert out == f"Nothing is wrong; 3 panoramas of {root} checked.\n"
    assert "Warning" not in err


def test_distances_are_counted_and_stored(tmp_path: Path, capsys: Capture) -> None:
    """Depth in 1/1000 m without labels or classes; a third is missing, and one file in meters."""
    for name, unit in (("a", 1000), ("b", 1000), ("test", 1)):
        save(tmp_path / "images" / f"{name}.png", np.full((32, 64, 3), 9, np.uint8))
        depth = np.full((32, 64), 3 * unit, np.uint16)
        depth[:, ::4] = 0
        write_png(tmp_path / "depth" / f"{name}.png", depth)
    (tmp_path / "test.txt").write_text("test")
    _, err = _checked(tmp_path, capsys, "task=depth")
    assert "Pixels of each label, %" in err
    rows = [line.split() for line in err.splitlines()]
    shares = {words[1]: words[3::2] for words in rows if words[:1] == ["│"]}
    assert shares == {"unknown": ["25.0", "25.0"], "distance": ["75.0", "75.0"]}
    (warning,) = (line for line in err.splitlines() if line.startswith("Warning: "))
    assert f"{tmp_path}/depth/test.png: median distance 0.00391 m" in warning
    stores = tmp_path / "stores"
    settings = ["data=folder", "level=4", f"data.root='{tmp_path}'", "data.val_fraction=0"]
    prepare(composed_settings("prepare", *settings, f"data.cache='{stores}'", "task=depth"))
    stored = np.load(next(stores.rglob("a.*.npy")))
    assert stored.dtype.names == ("rgb", "labels")
    assert np.unique(stored["labels"]).tolist() == [0, 3 * 512]


def test_images_of_another_shape_than_the_area_are_named(tmp_path: Path, capsys: Capture) -> None:
    write_classes(tmp_path, [None, "door"])
    for name in ("a", "b", "c"):
        save(tmp_path / "images" / f"{name}.png", np.zeros((12, 64, 3), np.uint8))
        save(tmp_path / "labels" / f"{name}.png", np.ones((12, 64), np.uint8))
    (tmp_path / "test.txt").write_text("a")
    area = "[-180,180,-33.75,33.75]"
    _checked(tmp_path, capsys, f"data.area={area}")
    with pytest.raises(SystemExit):
        _checked(tmp_path, capsys, "data.area=[-180,180,-60,60]")
    out = capsys.readouterr().out
    assert out.count("expected 64 × 21.3 (width × height): square pixels in area=") == 3
