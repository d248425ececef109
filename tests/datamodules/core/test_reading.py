"""The images of a split: read, rotated, made upright, kept in memory."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.core.images import ImageFiles, Panorama
from datamodules.core.reading import SplitReader
from datamodules.core.splits import DatasetIndex
from datamodules.core.transforms import EstimatedUp, PosedUp, RotatedPanoramas
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions

FILES = [ImageFiles(name, Path(name), Path("labels")) for name in ("0", "1")]
UP = np.array([0.6, 0.0, 0.8])


def _rgb(files: ImageFiles) -> NDArray[np.uint8]:
    return np.full((64, 128, 3), int(files.name), np.uint8)


def _heights() -> Panorama:
    """A panorama whose labels, colors and depth tell the direction's height z."""
    z = np.round(100 + 100 * equirect_directions((32, 64))[..., 2])
    labels = z.astype(np.uint8)
    return Panorama(np.stack([labels] * 3, axis=-1), z.astype(np.uint16), labels)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 180.0])
def test_tilt_is_exact_and_yaw_random(tilt: float) -> None:
    rotations = [RotatedPanoramas(tilt, seed=1).rotation(index) for index in range(2)]
    for rotation in rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1))) == pytest.approx(tilt)
    assert not np.allclose(rotations[0], rotations[1])


def test_rotations_are_those_of_seed_and_index() -> None:
    first, again, other = (RotatedPanoramas("so3", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.rotation(0), again.rotation(0))
    assert not np.allclose(first.rotation(0), first.rotation(1))
    assert not np.allclose(first.rotation(0), other.rotation(0))


@pytest.mark.parametrize("rotation", [40.0, "so3"])
@pytest.mark.parametrize("up", [None, UP])
def test_image_depth_labels_and_up_rotate_together(
    rotation: float | Literal["so3"], up: NDArray[np.float64] | None
) -> None:
    rotated = RotatedPanoramas(rotation, seed=5, known=True)
    rgb, depth, labels, found, _ = rotated(_heights()._replace(up=up), 0)
    R = rotated.rotation(0)
    # The output direction d shows the input at Rᵀd, whose height is the third row of Rᵀ times d.
    expected = 100 + 100 * equirect_directions((32, 64)) @ R[:, 2]
    np.testing.assert_allclose(labels.astype(float), expected, atol=8)
    np.testing.assert_allclose(rgb[..., 1].astype(float), expected, atol=8)
    assert depth is not None
    np.testing.assert_array_equal(depth, labels)  # both nearest: the same source pixels
    assert found is not None
    np.testing.assert_allclose(found, R @ ((0, 0, 1) if up is None else up), atol=1e-12)
    unknown = RotatedPanoramas(rotation, seed=5)(_heights()._replace(depth=None, up=up), 0)
    assert (unknown.depth, unknown.up) == (None, None)


def test_files_are_asked_once_where_up_is(monkeypatch: pytest.MonkeyPatch) -> None:
    estimated: list[str] = []

    def read_up(path: Path) -> NDArray[np.float64] | None:
        estimated.append(str(path))
        return UP if str(path) == "1" else None

    monkeypatch.setattr("datamodules.core.transforms.read_up", read_up)
    posed = PosedUp()
    for _ in range(2):
        assert posed(_heights(), 0, FILES[0]).up is None
        np.testing.assert_array_equal(posed(_heights(), 1, FILES[1]).up, UP)
    assert estimated == ["0", "1"]


@pytest.mark.parametrize("found", [None, UP])
def test_only_unknown_up_directions_are_estimated_and_only_once(
    monkeypatch: pytest.MonkeyPatch, found: NDArray[np.float64] | None
) -> None:
    estimated: list[float] = []

    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float, judge: Any) -> Any:
        assert judge is None
        estimated.append(max_tilt_deg)
        return found

    monkeypatch.setattr("datamodules.core.transforms.estimate_up", estimate)
    upright = EstimatedUp(50, _rgb)
    for _ in range(2):
        np.testing.assert_array_equal(upright(_heights()._replace(up=-UP), 1, FILES[1]).up, -UP)
        assert upright(_heights(), 0, FILES[0]).up is found
    assert estimated == [50]


def test_a_judge_sees_the_panorama_and_stays_in_its_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def judge(panorama: Panorama, ups: NDArray[np.float64]) -> NDArray[np.float64]:
        np.testing.assert_array_equal(panorama.rgb, _heights().rgb)
        return -ups[:, 0]

    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float, judge: Any) -> Any:
        up = np.array([-1.0, 0, 0])
        assert judge is None or judge(np.eye(3)).argmax() != 0
        return up if judge is not None else UP

    monkeypatch.setattr("datamodules.core.transforms.estimate_up", estimate)
    upright = EstimatedUp(180, _rgb, None, judge)
    judged = upright(_heights(), 0, FILES[0]).up
    sent = pickle.loads(pickle.dumps(upright))  # as to a worker
    np.testing.assert_array_equal(sent(_heights(), 0, FILES[0]).up, judged)
    np.testing.assert_array_equal(sent(_heights(), 1, FILES[1]).up, UP)


def test_images_in_memory_are_read_once_and_broken_ones_are_listed() -> None:
    read: list[str] = []

    def decode(files: ImageFiles) -> Panorama:
        read.append(files.name)
        if files.name == "broken":
            raise DataError(files.rgb, found="nothing", expected="a panorama")
        return _heights()._replace(depth=None)

    def double(panorama: Panorama, index: int, files: Any) -> Panorama:
        return panorama._replace(labels=panorama.labels * 0 + index)

    splits: Any = {"train": [], "val": [], "test": FILES}
    items = SplitReader(DatasetIndex("panoramas", splits, decode, Panorama), "test", [double])
    items.keep_in_memory("data")
    for index in (0, 1):
        np.testing.assert_array_equal(items.read(index).rgb, _heights().rgb)
        assert np.unique(items.labels(index)).tolist() == [index]
    assert (items.read(0).depth, items.name(1), len(items)) == (None, "1", 2)
    assert sorted(read) == ["0", "1"]
    broken = [file._replace(name="broken", rgb=Path(f"b{file.name}")) for file in FILES]
    with pytest.raises(DataError, match=r"data: found 2 problems(.|\n)*b0(.|\n)*b1"):
        SplitReader(
            DatasetIndex("panoramas", {**splits, "test": broken}, decode, Panorama), "test"
        ).keep_in_memory("data")
