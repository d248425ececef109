"""Measures of panoramas: seam, poles, boundaries."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.geometry import equirect_solid_angles
from tangent_train.heads import ClassesHead, DistanceHead
from tangent_train.metrics.image_sums import drawn_scores, intervals
from tangent_train.metrics.sphere import BOUNDARY_DEG, near_boundary

NAMES = ("unknown", "a", "b", "c")


def _scores(
    images: Any, head: Any = None
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Scores of predictions and truths, and their intervals."""
    head = head or ClassesHead(NAMES)
    metric = head.build_metric()
    for prediction, truth in images:
        metric.update(*(torch.from_numpy(np.ascontiguousarray(x)) for x in (prediction, truth)))
    result = metric.compute()
    return dict(head.scores(result).means), intervals(drawn_scores(head.image_sums(result)))


def _stripes(height: int, width: int) -> NDArray[np.uint8]:
    """Three classes in each row, with borders at other columns in other rows."""
    rows, columns = np.indices((height, width))
    return ((columns + rows // 3) * 3 // width % 3 + 1).astype(np.uint8)


def test_a_perfect_prediction_has_no_gaps() -> None:
    truth = _stripes(48, 96)
    scores, of_scores = _scores([(truth, truth)] * 2)
    assert scores["boundary_miou"] == 1
    assert {scores[name] for name in ("pole_gap", "seam_gap", "seam_step")} == {0}
    assert of_scores["seam_step"] == (0, 0)


def test_errors_near_the_poles_are_the_pole_gap() -> None:
    """Latitudes of 60° and 30° are edges of rows 8 and 16 of 48; half of the caps is wrong."""
    truth = np.ones((48, 96), np.uint8)
    truth[:, 48:] = 2
    prediction = truth.copy()
    prediction[:8, 48:] = prediction[40:, 48:] = 1
    scores, _ = _scores([(prediction, truth)])
    # Of class a: half of what is predicted; of class b: nothing.
    assert scores["pole_gap"] == pytest.approx(0.25 - 1)


def test_a_seam_of_known_height() -> None:
    """The left half is wrong in rows 12 to 35, which have the share sin 45° of the sphere."""
    truth = np.full((48, 96), 2, np.uint8)
    prediction = truth.copy()
    prediction[12:36, :48] = 1
    share = equirect_solid_angles((48, 96))[12:36].sum() / equirect_solid_angles((48, 96)).sum()
    assert share == pytest.approx(math.sin(math.pi / 4))
    scores, _ = _scores([(prediction, truth)])
    assert scores["seam_step"] == pytest.approx(share - share / 95), "the middle is one of 95"
    distances, true = (np.where(x == 1, math.e, 1.0) for x in (prediction, truth))
    scores, _ = _scores([(distances, true)], DistanceHead(depth_kind="metric_distance"))
    assert scores["seam_step"] == pytest.approx(share - share / 95)


def test_the_seam_of_the_truth_is_subtracted() -> None:
    truth = np.ones((48, 96), np.uint8)
    truth[:, :48] = 2
    assert _scores([(truth, truth)])[0]["seam_step"] == 0
    shifted = np.roll(truth, 10, axis=1)
    assert _scores([(shifted, truth)])[0]["seam_step"] == pytest.approx(-1 - 1 / 95)


def test_errors_near_the_seam_are_the_seam_gap() -> None:
    """5 % of 100 columns on each side, of which one is all wrong."""
    truth = np.ones((50, 100), np.uint8)
    truth[25:] = 2
    prediction = truth.copy()
    prediction[:25, :5] = 2
    scores, _ = _scores([(prediction, truth)])
    # Class a: 5 of 10 columns; class b: 10 of 15.
    assert scores["seam_gap"] == pytest.approx((1 / 2 + 2 / 3) / 2 - 1)


def test_a_boundary_off_by_half_a_degree() -> None:
    """Rows of half a degree: bands of two rows share one of three."""
    assert BOUNDARY_DEG == 1
    truth = np.where(np.arange(360) < 180, 1, 2).astype(np.uint8)[:, None].repeat(720, axis=1)
    scores, _ = _scores([(np.roll(truth, 1, axis=0), truth)])
    # The roll also makes the first row class b, which is a boundary near the pole.
    assert scores["boundary_miou"] == pytest.approx(1 / 3, abs=0.01)


@pytest.mark.parametrize("shape", [(90, 180), (7, 14), (6, 12), (1, 2)])
def test_pixels_near_boundaries_equal_loops(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    labels = (rng.random(shape) < 0.02).astype(np.uint8)
    height, width = shape
    down, expected = max(1, round(height / 180)), np.zeros(shape, bool)
    for row, column in itertools.product(range(height), range(width)):
        latitude = math.pi / 2 - (row + 0.5) * math.pi / height
        across = min(max(1, round(width / 360 / math.cos(latitude))), width // 2)
        for r, c in itertools.product(
            range(row - down, row + down + 1), range(-across, across + 1)
        ):
            beyond = not 0 <= r < height
            mirrored = -1 - r if r < 0 else 2 * height - 1 - r if r >= height else r
            place = (column + c + beyond * (width // 2)) % width
            expected[row, column] |= labels[mirrored, place] != labels[row, column]
    np.testing.assert_array_equal(near_boundary(labels), expected)


def test_photos_have_no_such_scores() -> None:
    crops = np.ones((2, 8, 8), np.uint8)
    scores, of_scores = _scores([(crops, crops)] * 2)
    assert not {"seam_step", "pole_gap", "boundary_miou"} & (scores.keys() | of_scores.keys())
    scores, _ = _scores([(crops * 1.0, crops * 1.0)], DistanceHead(depth_kind="metric_distance"))
    assert "seam_step" not in scores


def test_labels_of_unknown_pixels_do_not_count() -> None:
    truth = _stripes(48, 96)
    truth[10:20, 30:50] = 0
    predictions = [np.roll(truth, 2, axis=1), np.roll(truth, 2, axis=1)]
    for label, prediction in enumerate(predictions, start=1):
        prediction[truth == 0] = label
        prediction[(prediction == 0) & (truth > 0)] = 1
    first, second = (_scores([(prediction, truth)])[0] for prediction in predictions)
    assert first == second
    assert first["boundary_miou"] < 1
