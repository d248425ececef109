"""PMR, MS and P against an example computed by hand, and the paper's own rows."""

from __future__ import annotations

import math

import pytest

from tangent_train.errors import SettingError
from tangent_train.keypoints.scores import PairScores, mean_scores

# By hand: 40 matches, 10 of them good, 100 and 50 keypoints to be seen:
# PMR = (40/100 + 40/50) / 2 = 0.6, MS = (10/100 + 10/50) / 2 = 0.15, P = 10/40 = 0.25.
FIRST = PairScores(40, 10, 100, 50)
# PMR = (6/20 + 6/60) / 2 = 0.2, MS = (3/20 + 3/60) / 2 = 0.1, P = 0.5.
SECOND = PairScores(6, 3, 20, 60)


def test_a_pair_by_hand() -> None:
    assert (FIRST.pmr, FIRST.ms, FIRST.precision) == pytest.approx((0.6, 0.15, 0.25))
    assert (SECOND.pmr, SECOND.ms, SECOND.precision) == pytest.approx((0.2, 0.1, 0.5))


def test_pairs_have_the_same_weight() -> None:
    scores = mean_scores([FIRST, SECOND])
    assert scores[:3] == pytest.approx((0.4, 0.125, 0.375))
    assert scores[3:] == (2, 2, 2)
    # The equation as printed: a sum over pairs of both shares, over twice their number.
    pairs = (FIRST, SECOND)
    pmr = sum(p.putative / p.visible_left + p.putative / p.visible_right for p in pairs) / 4
    assert scores.pmr == pytest.approx(pmr)


def test_a_score_of_nothing_is_no_number_and_left_out() -> None:
    unmatched = PairScores(0, 0, 10, 10)
    assert (unmatched.pmr, unmatched.ms) == (0, 0)
    assert math.isnan(unmatched.precision)
    unseen = PairScores(4, 1, 0, 10)
    assert math.isnan(unseen.pmr)
    assert math.isnan(unseen.ms)
    assert unseen.precision == 0.25
    scores = mean_scores([FIRST, unmatched, unseen])
    assert scores[:3] == pytest.approx((0.3, 0.075, 0.25))
    assert scores[3:] == (3, 2, 2)


def test_no_pairs_have_no_scores() -> None:
    scores = mean_scores([])
    assert all(math.isnan(value) for value in scores[:3])
    assert scores[3:] == (0, 0, 0)


def test_hidden_keypoints_may_match() -> None:
    assert PairScores(12, 6, 10, 10).pmr == 1.2  # as L1 of the paper's pair 25, 1.01


@pytest.mark.parametrize("counts", [(-1, 0, 1, 1), (3, 4, 9, 9), (3, 2, -1, 1)])
def test_counts_that_cannot_be(counts: tuple[int, int, int, int]) -> None:
    with pytest.raises(SettingError, match="counts of a pair"):
        mean_scores([PairScores(*counts)])
