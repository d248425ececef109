"""PMR, MS and P (paper, section "Sparse keypoint correspondences", after Heinly et al. 2012)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from tangent_train.errors import SettingError

__all__ = ["MeanScores", "PairScores", "mean_scores"]


class PairScores(NamedTuple):
    """Counts of one pair of images, and its scores as shares (the paper prints percent).

    A score whose denominator is 0 is NaN.

    Attributes:
        putative: p, putative correspondences.
        inliers: f, matches that agree with the geometry of the two views.
        visible_left: n_L, keypoints of the left image that the right one should see.
        visible_right: n_R, keypoints of the right image that the left one should see. Where depth
            or poses are unknown all keypoints are counted in both.

    >>> pair = PairScores(putative=30, inliers=12, visible_left=100, visible_right=60)
    >>> round(pair.pmr, 6), round(pair.ms, 6), pair.precision
    (0.4, 0.16, 0.4)
    """

    putative: int
    inliers: int
    visible_left: int
    visible_right: int

    @property
    def pmr(self) -> float:
        """Putative matching ratio, ``(p / n_L + p / n_R) / 2``.

        Above 1 where keypoints match that count as hidden.
        """
        return self._of_visible(self.putative)

    @property
    def ms(self) -> float:
        """Matching score, ``(f / n_L + f / n_R) / 2``."""
        return self._of_visible(self.inliers)

    @property
    def precision(self) -> float:
        """Precision P, ``f / p``."""
        return _share(self.inliers, self.putative)

    def _of_visible(self, count: int) -> float:
        shares = _share(count, self.visible_left), _share(count, self.visible_right)
        return (shares[0] + shares[1]) / 2


class MeanScores(NamedTuple):
    """Scores averaged over pairs, each pair with the same weight.

    Attributes:
        pmr: Mean PMR as a share; NaN where no pair has one.
        ms: Mean MS.
        precision: Mean P.
        pairs: Number of pairs.
        scored: Pairs whose PMR and MS are numbers: keypoints of both images should be seen.
        matched: Pairs whose P is a number: they have putative matches.
    """

    pmr: float
    ms: float
    precision: float
    pairs: int
    scored: int
    matched: int


def mean_scores(pairs: Iterable[PairScores]) -> MeanScores:
    """The paper's scores of a set of pairs: means of the pairs' scores, not of their counts.

    Pairs whose score is NaN, because nothing was there to be counted, are left out of the mean of
    that score; the result says how many remain. A pair without inliers counts as 0.

    Args:
        pairs: Counts of the pairs.

    Raises:
        SettingError: A count is negative or there are more inliers than matches.
    """
    every = list(pairs)
    for pair in every:
        if min(pair) < 0 or pair.inliers > pair.putative:
            raise SettingError("counts of a pair", found=pair, expected="0 <= inliers <= putative")
    pmr, scored = _mean(pair.pmr for pair in every)
    ms, _ = _mean(pair.ms for pair in every)
    precision, matched = _mean(pair.precision for pair in every)
    return MeanScores(pmr, ms, precision, len(every), scored, matched)


def _share(count: int, of: int) -> float:
    return count / of if of else math.nan


def _mean(values: Iterable[float]) -> tuple[float, int]:
    numbers = [value for value in values if not math.isnan(value)]
    return (math.fsum(numbers) / len(numbers) if numbers else math.nan), len(numbers)
