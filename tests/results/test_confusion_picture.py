"""Where classes went, read off the picture again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.results.chart import confusion_picture, row_shares

DARKEST = (8, 48, 107)  # all pixels of a class
GREY = (204, 204, 204)


def _names(count: int) -> list[str]:
    return ["unknown", *(f"class of some length {k}" for k in range(count))]


def _places(picture: NDArray[np.uint8], color: tuple[int, int, int]) -> NDArray[np.float64]:
    """Centres (x, y) of the squares of a colour, from top to bottom."""
    mask = np.all(picture == color, axis=-1).astype(np.uint8)
    if color == DARKEST:  # over the numbers; not over the lines between neighbours
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9)))
    count, _, stats, centers = cv2.connectedComponentsWithStats(mask)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] > 500]
    return centers[sorted(large, key=lambda k: float(centers[k, 1]))]


@pytest.mark.parametrize("count", [1, 2, 13, 40])
def test_every_class_has_its_row_and_column(count: int) -> None:
    order = np.random.default_rng(count).permutation(count)
    matrix = np.zeros((count + 1, count + 1), np.int64)
    matrix[np.arange(1, count + 1), order + 1] = 7
    matrix[0] = 1000  # what nobody knows does not count
    picture = confusion_picture(matrix, _names(count))
    places = _places(picture, DARKEST)
    assert len(places) == count, "a square per class"
    np.testing.assert_array_equal(np.argsort(np.argsort(places[:, 0])), order)
    if count > 1:
        steps = np.diff(places[:, 1])
        assert steps.min() > 30, "room for two digits"
        assert np.ptp(steps) < 2
    assert max(picture.shape) < 2000


def test_shares_are_those_of_the_labelled_pixels() -> None:
    matrix = np.array([[9, 9, 9, 9], [1, 2, 1, 0], [0, 0, 0, 0], [0, 3, 0, 1]])
    shares = row_shares(matrix)
    np.testing.assert_array_equal(shares[0], [0.5, 0.25, 0.0])
    assert np.isnan(shares[1]).all()
    np.testing.assert_array_equal(shares[2], [0.75, 0.0, 0.25])


def test_rows_of_absent_classes_are_grey() -> None:
    matrix = 5 * np.eye(4, dtype=np.int64)
    matrix[2] = 0
    picture = confusion_picture(matrix, _names(3))
    absent, present = _places(picture, GREY), _places(picture, DARKEST)
    assert len(present) == 2
    assert len(absent) == 3
    assert np.ptp(absent[:, 1]) < 1
    assert present[0, 1] < absent[0, 1] < present[1, 1]


def test_many_classes_are_drawn_small_and_without_numbers() -> None:
    count = 90
    picture = confusion_picture(
        np.ones((count + 1, count + 1)), ["unknown", *(f"class {k}" for k in range(count))]
    )
    assert max(picture.shape) < 2500
