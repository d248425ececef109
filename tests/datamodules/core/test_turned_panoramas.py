"""Panoramas that are not upright."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest

from datamodules.core.panoramas import Panorama
from datamodules.core.sources import count_labels
from datamodules.core.turned_panoramas import PosedPanoramas, TurnedPanoramas, UprightPanoramas
from tangent_train.geometry import equirect_directions
from tangent_train.rendering.upright.gravity import Gravity
from tests.datamodules.core.test_panoramas import Memory

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def _positions() -> Panorama:
    """A panorama whose labels, colours and depth tell the direction's height z."""
    z = np.round(100 + 100 * equirect_directions((32, 64))[..., 2])
    labels = z.astype(np.uint8)
    return Panorama(np.stack([labels] * 3, axis=-1), z.astype(np.uint16), labels)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 90.0, 180.0])
def test_tilt_is_exact_and_yaw_random(tilt: float) -> None:
    turned = TurnedPanoramas(Memory([_positions()] * 3), tilt, seed=1)
    rotations = [turned.rotation(i) for i in range(3)]
    for rotation in rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1))) == pytest.approx(tilt)
    assert not np.allclose(rotations[0], rotations[1])


def test_turns_are_those_of_seed_and_index() -> None:
    source = Memory([_positions()] * 2)
    first, again, other = (TurnedPanoramas(source, "so3", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.rotation(0), again.rotation(0))
    assert not np.allclose(first.rotation(0), first.rotation(1))
    assert not np.allclose(first.rotation(0), other.rotation(0))


@pytest.mark.parametrize("rotation", [40.0, "so3"])
def test_image_depth_and_labels_turn_together(rotation: float | Literal["so3"]) -> None:
    turned = TurnedPanoramas(Memory([_positions()]), rotation, seed=5)
    rgb, depth, labels, up = turned.read(0)
    assert up is None
    # The output direction d shows the input at Rᵀd, whose height is the third row of Rᵀ times d.
    height = equirect_directions((32, 64)) @ turned.rotation(0)[:, 2]
    np.testing.assert_allclose(labels.astype(float), 100 + 100 * height, atol=8)
    np.testing.assert_allclose(rgb[..., 1].astype(float), 100 + 100 * height, atol=8)
    np.testing.assert_array_equal(turned.label_counts(0), count_labels(labels))
    assert depth is not None
    np.testing.assert_array_equal(depth, labels)  # both nearest: the same source pixels
    assert (len(turned), turned.name(0)) == (1, "panorama 0")


def test_turning_without_depth() -> None:
    source = Memory([_positions()._replace(depth=None)])
    assert TurnedPanoramas(source, "so3", 0).read(0).depth is None


# Where up is.

UP = np.array([0.6, 0.0, 0.8])


def test_turned_panoramas_know_where_up_is_now() -> None:
    posed = _positions()._replace(up=UP)
    for panorama, before in ((_positions(), np.array([0.0, 0.0, 1.0])), (posed, UP)):
        turned = TurnedPanoramas(Memory([panorama]), 40, seed=5, known=True)
        found = turned.read(0).up
        assert found is not None
        np.testing.assert_allclose(found, turned.rotation(0) @ before, atol=1e-12)
        assert TurnedPanoramas(Memory([panorama]), 40, seed=5).read(0).up is None


def test_files_are_asked_once_where_up_is(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def up_of(path: Path) -> NDArray[np.float64] | None:
        asked.append(str(path))
        return UP if str(path) == "1" else None

    monkeypatch.setattr("datamodules.core.turned_panoramas.up_of", up_of)

    class Files(Memory):
        def files(self, index: int) -> dict[str, str]:
            return {"rgb": str(index)}

    source: Any = Files([_positions()] * 2)
    posed = PosedPanoramas(source, source)
    for _ in range(2):
        assert posed.read(0).up is None
        np.testing.assert_array_equal(posed.read(1).up, UP)
    assert asked == ["0", "1"]
    assert (len(posed), posed.name(1)) == (2, "panorama 1")
    np.testing.assert_array_equal(posed.label_counts(0), source.label_counts(0))


@pytest.mark.parametrize("confidence", [0.0, 0.9])
def test_only_what_nothing_says_is_estimated_and_only_once(
    monkeypatch: pytest.MonkeyPatch, confidence: float
) -> None:
    asked: list[float] = []

    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float) -> Gravity:
        asked.append(max_tilt_deg)
        return Gravity(UP if confidence else np.array([0.0, 0, 1]), confidence, UP[None])

    monkeypatch.setattr("datamodules.core.turned_panoramas.estimate_up", estimate)
    known = _positions()._replace(up=-UP)
    upright = UprightPanoramas(Memory([_positions(), known]), 50)
    for _ in range(2):
        np.testing.assert_array_equal(upright.read(1).up, -UP)
        if confidence:
            np.testing.assert_array_equal(upright.read(0).up, UP)
        else:
            assert upright.read(0).up is None
    assert asked == [50]
