"""Names, cameras, labels, depth and splits of SYNTHIA."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.core.panoramas import ImageFiles
from datamodules.synthia.omnisynthia import divide
from datamodules.synthia.reader import (
    CLASSES,
    VIEW_FORMATS,
    SynthiaReader,
    choose_frames,
    read_camera,
)
from tangent_train.errors import DataError
from tests.datamodules.data_files import write_png

# --- cameras -------------------------------------------------------------------------------------


def _write_camera(folder: Path, text: str) -> Path:
    path = folder / "CameraParams" / "intrinsics.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    ["532.740352\n640\n380\n0.8\n", "532.740352, 640, 380", None],
)
def test_cameras(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        _write_camera(tmp_path, text)
    camera = read_camera(tmp_path, (760, 1280))
    # Counted from pixel corners the centre is the middle of the image; so it is here.
    expected = [[532.740352, 0, 639.5], [0, 532.740352, 379.5], [0, 0, 1]]
    np.testing.assert_array_equal(camera, expected)


@pytest.mark.parametrize(
    "text",
    ["focal 532 640 380", "532 640 380 0.8 1", "nan 640 380", "532 64000 380"],
)
def test_strange_cameras(tmp_path: Path, text: str) -> None:
    _write_camera(tmp_path, text)
    with pytest.raises(DataError, match=r"intrinsics\.txt: found .* views of 760×1280"):
        read_camera(tmp_path, (760, 1280))


# --- labels and depth ----------------------------------------------------------------------------


def _labels(tmp_path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    path = tmp_path / "labels.png"
    write_png(path, image)
    return SynthiaReader(VIEW_FORMATS).labels(ImageFiles("a", path, path))


def test_classes(tmp_path: Path) -> None:
    labels = _labels(tmp_path, np.array([[*range(16), 255]], np.uint8))
    assert labels.tolist() == [[*range(13), 0, 0, 13, 0]]
    names = dict(zip(labels[0].tolist(), ["unknown", *CLASSES], strict=False))
    assert (names[1], names[3], names[12]) == ("sky", "road", "lane marking")
    assert CLASSES[13 - 1] == "traffic light"


@pytest.mark.parametrize("value", [16, 256])
def test_there_are_no_other_labels(tmp_path: Path, value: int) -> None:
    image = np.full((2, 2), value, np.uint16 if value > 255 else np.uint8)
    with pytest.raises(DataError, match=rf"labels\.png: found labels {value}; expected 0 to 15"):
        _labels(tmp_path, image)


def test_steps_of_depth(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    write_png(path, np.arange(65536, dtype=np.uint16).reshape(256, 256))
    steps = SynthiaReader(VIEW_FORMATS).depth(ImageFiles("a", path, path, path)).ravel()
    assert steps.dtype == np.uint16
    exact = np.arange(65536) / 100 * 512
    near = exact < 65535
    assert np.abs(steps - exact)[near].max() <= 0.5
    assert (steps[~near] == 65535).all()
    assert np.flatnonzero(steps == 0).tolist() == [0]  # missing stays missing, and nothing else is


# --- splits --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "step"),
    [(1, 1), (749, 1), (750, 2), (1250, 3)],
)
def test_every_nth_frame(count: int, step: int) -> None:
    frames = [f"{i:06d}" for i in range(count)]
    assert choose_frames(frames) == [f"{i:06d}" for i in range(0, count, step)]


@pytest.mark.parametrize(("fraction", "held"), [(0.0, 0), (0.01, 1), (0.1, 3), (0.999, 28)])
def test_validation_takes_the_end_of_every_sequence(fraction: float, held: int) -> None:
    frames = [[ImageFiles(str(i), Path(), Path())] for i in range(29)]
    divided = divide({"01": frames, "04": frames}, ["04"], fraction)
    found = {split: [int(files.name) for files in chosen] for split, chosen in divided.items()}
    expected = {"train": range(29 - held), "val": range(29 - held, 29), "test": range(29)}
    assert found == {split: list(numbers) for split, numbers in expected.items()}
