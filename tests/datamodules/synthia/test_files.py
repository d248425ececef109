"""Names, cameras, labels, depth and splits of SYNTHIA."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from datamodules.synthia.files import (
    PANORAMA_FORMATS,
    VIEW_FORMATS,
    VIEWS,
    check_files,
    list_frames,
    list_panoramas,
    panorama_files,
    read_camera,
    sequence_folder,
    view_files,
)
from datamodules.synthia.pixels import (
    CLASSES,
    decode_labels,
    default_normalization,
    depth_steps,
    read_first_channel,
    read_view_labels,
)
from datamodules.synthia.splits import SequenceSplits, choose_frames
from tangent_train.errors import DataError, SettingError
from tests.datamodules.synthia import synthia_format as synthia

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence of two frames with views and three with panoramas; not to be changed."""
    root = synthia.write_views(tmp_path_factory.mktemp("synthia"), {"05": 2})
    return synthia.sequence(synthia.write_panoramas(root, {"05": 3}), "05")


# --- names ---------------------------------------------------------------------------------------


def test_files_are_where_the_release_has_them(folder: Path) -> None:
    assert sequence_folder(folder.parent, "05") == folder
    for view in VIEWS:
        assert check_files(view_files(folder, view, "000001", with_depth=True), VIEW_FORMATS) == (
            synthia.SIZE
        )
    files = panorama_files(folder, "000002", with_depth=True)
    assert check_files(files, PANORAMA_FORMATS) == (32, 64)
    assert list(files.parts) == ["rgb", "labels", "depth"]
    assert list(panorama_files(folder, "000002", with_depth=False).parts) == ["rgb", "labels"]


def test_frames_are_those_of_any_view(tmp_path: Path) -> None:
    for view, names in {"F": ("000002", "000000"), "L": ("000010", "._000003", "notes")}.items():
        rgb = tmp_path / "RGB" / "Stereo_Left" / f"Omni_{view}"
        rgb.mkdir(parents=True)
        for name in names:
            (rgb / f"{name}.png").touch()
    assert list_frames(tmp_path) == ["000000", "000002", "000010"]
    assert list_panoramas(tmp_path) == []


def test_panoramas_by_name(folder: Path) -> None:
    assert list_panoramas(folder) == ["000000", "000001", "000002"]


# --- cameras -------------------------------------------------------------------------------------


def _write_camera(folder: Path, text: str) -> Path:
    path = folder / "CameraParams" / "intrinsics.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "532.740352\n640\n380\n0.8\n",
        "532.740352 640 380",
        "532.740352 0.0 640.0\n0.0 532.740352 380.0\n0.0 0.0 1.0\n",
        "532.740352, 0, 640, 0, 532.740352, 380, 0, 0, 1",
        None,
    ],
)
def test_cameras(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        _write_camera(tmp_path, text)
    camera = read_camera(tmp_path, (760, 1280))
    # Counted from pixel corners the centre is the middle of the image; so it is here.
    expected = [[532.740352, 0, 639.5], [0, 532.740352, 379.5], [0, 0, 1]]
    np.testing.assert_array_equal(camera, expected)


def test_the_field_of_view_of_the_release(tmp_path: Path) -> None:
    K = read_camera(tmp_path, (760, 1280))
    left, right = (np.linalg.inv(K) @ (x, 379.5, 1) for x in (-0.5, 1279.5))
    width = np.degrees(np.arctan(right[0]) - np.arctan(left[0]))
    assert width == pytest.approx(100.45, abs=0.01)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "focal 532 640 380",
        "532 640",
        "532 640 380 0.8 1",
        "-532 640 380",
        "nan 640 380",
        "532 64000 380",
        "532 640 -3",
        "532 1 640 0 532 380 0 0 1",
        "532 0 640 0 532 380 0 0 2",
    ],
)
def test_strange_cameras(tmp_path: Path, text: str) -> None:
    _write_camera(tmp_path, text)
    with pytest.raises(DataError, match=r"intrinsics\.txt: found .* 3×3 .* 760×1280"):
        read_camera(tmp_path, (760, 1280))


def test_unknown_cameras_of_other_views(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"intrinsics\.txt: found no such file, .* 38×64"):
        read_camera(tmp_path, synthia.SIZE)


# --- labels and depth ----------------------------------------------------------------------------


def test_the_class_of_a_view_is_in_the_first_channel(tmp_path: Path) -> None:
    ids = np.arange(16, dtype=np.uint16).reshape(2, 8)
    path = tmp_path / "labels.png"
    synthia.write_png(path, np.stack([ids + 700, 15 - ids, ids], axis=-1))  # blue, green, red
    labels = read_view_labels(path)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, ids)


@pytest.mark.parametrize("value", [16, 255, 256, 3000])
def test_views_have_no_other_labels(tmp_path: Path, value: int) -> None:
    path = tmp_path / "labels.png"
    synthia.write_png(path, np.full((2, 2, 3), value, np.uint16))
    with pytest.raises(DataError, match=rf"labels\.png: found labels {value}; expected 0 to 15"):
        read_view_labels(path)


def test_classes(tmp_path: Path) -> None:
    ids = np.array([[*range(16), 255]], np.uint8)
    labels = decode_labels(ids, tmp_path)
    assert labels.tolist() == [[*range(13), 0, 0, 13, 0]]
    names = dict(zip(labels[0].tolist(), ["unknown", *CLASSES], strict=False))
    assert (names[1], names[3], names[12]) == ("sky", "road", "lane marking")
    assert CLASSES[13 - 1] == "traffic light"
    for value in (16, 100, 254):
        with pytest.raises(DataError, match=f"found labels {value};"):
            decode_labels(np.array([[1, value, 255]], np.uint8), tmp_path)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_depth_in_any_number_of_channels(tmp_path: Path, channels: int) -> None:
    depth = np.array([[0, 1, 255, 256, 40000, 65535]], np.uint16)
    # The others may hold anything: grey of these would be something else.
    image = depth if channels == 1 else np.stack([depth * 0, depth // 2, depth], axis=-1)
    if channels == 4:
        image = np.dstack([image, np.full(depth.shape, 7, np.uint16)])
    synthia.write_png(tmp_path / "depth.png", image)
    read = read_first_channel(tmp_path / "depth.png")
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, depth)


def test_broken_pixels(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    with pytest.raises(DataError, match="No such file"):
        read_first_channel(path)
    for content in (b"", b"no picture"):
        path.write_bytes(content)
        with pytest.raises(DataError, match="no PNG header"):
            read_first_channel(path)


def test_steps_of_depth() -> None:
    centimeters = np.arange(65536).astype(np.uint16)
    steps = depth_steps(centimeters)
    assert steps.dtype == np.uint16
    exact = np.arange(65536) / 100 * 512
    near = exact < 65535
    assert np.abs(steps - exact)[near].max() <= 0.5
    assert (steps[~near] == 65535).all()
    assert np.flatnonzero(steps == 0).tolist() == [0]  # missing stays missing, and nothing else is


def test_normalization_of_depth_is_that_of_the_other_set() -> None:
    rgb, rgbd = default_normalization(("rgb",)), default_normalization(("rgb", "depth"))
    assert (rgb.channels, rgbd.channels) == (3, 4)
    assert rgbd.mean[:3] == rgb.mean == (0.4512, 0.4257, 0.3920)
    assert rgbd.std[3] == 0.75536704


# --- splits --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "step"),
    [(1, 1), (500, 1), (501, 1), (749, 1), (750, 2), (900, 2), (1249, 2), (1250, 3), (1451, 3)],
)
def test_every_nth_frame(count: int, step: int) -> None:
    frames = [f"{i:06d}" for i in range(count)]
    assert choose_frames(frames) == [f"{i:06d}" for i in range(0, count, step)]


def test_no_frames() -> None:
    assert choose_frames([], 5) == []
    with pytest.raises(SettingError, match=r"data\.frames: found 0"):
        choose_frames(["000000"], 0)


@pytest.mark.parametrize(
    ("fraction", "held"), [(0.0, [0, 0]), (0.1, [1, 3]), (0.5, [2, 14]), (0.999, [3, 28])]
)
def test_validation_takes_the_end_of_every_sequence(fraction: float, held: list[int]) -> None:
    lengths = {"01": 4, "02": 29, "04": 5}
    splits = SequenceSplits(("01", "02"), ("04",), fraction)
    divided = splits.divide(lambda name: [f"{name}/{i}" for i in range(lengths[name])])
    kept = [4 - held[0], 29 - held[1]]
    assert divided["train"] == [f"01/{i}" for i in range(kept[0])] + [
        f"02/{i}" for i in range(kept[1])
    ]
    assert divided["val"] == [f"01/{i}" for i in range(kept[0], 4)] + [
        f"02/{i}" for i in range(kept[1], 29)
    ]
    assert divided["test"] == [f"04/{i}" for i in range(5)]


def test_a_sequence_of_one_frame() -> None:
    with pytest.raises(DataError, match="sequence 01: found one frame"):
        SequenceSplits(("01",), ("04",), 0.1).divide(lambda _: ["000000"])
    one = SequenceSplits(("01",), ("04",), 0).divide(lambda _: ["000000"])
    assert [len(one[split]) for split in ("train", "val", "test")] == [1, 0, 1]


def test_numbers_are_sequences() -> None:
    train: Any = (1, "2")
    test: Any = [4]
    splits = SequenceSplits(train, test, 0.1)
    assert splits.sequences == ("01", "02", "04")


@pytest.mark.parametrize(
    ("train", "test", "fraction", "name"),
    [
        ((), ("04",), 0.1, "train_sequences"),
        (("03",), ("04",), 0.1, "train_sequences"),
        (("01",), (), 0.1, "test_sequences"),
        (("01", "04"), ("04",), 0.1, "test_sequences"),
        (("01",), ("04",), 1.0, "validation_fraction"),
        (("01",), ("04",), -0.1, "validation_fraction"),
    ],
)
def test_impossible_splits(
    train: tuple[str, ...], test: tuple[str, ...], fraction: float, name: str
) -> None:
    with pytest.raises(SettingError, match=rf"data\.{name}"):
        SequenceSplits(train, test, fraction)


def test_the_fabricated_world_has_all_classes(folder: Path) -> None:
    found: NDArray[np.uint8] = np.concatenate(
        [read_view_labels(view_files(folder, v, "000000", with_depth=False).labels) for v in VIEWS]
    )
    assert set(found.ravel().tolist()) == set(synthia.IDS.tolist())
