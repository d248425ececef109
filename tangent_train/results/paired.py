"""Differences between evaluations of the same images, with paired intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tangent_train.metrics.image_sums import drawn_scores, intervals, means_of_sums
from tangent_train.metrics.scores import Interval
from tangent_train.results.evaluation import SUMS_FILE, EvaluationResult


@dataclass(frozen=True)
class Difference:
    """Scores of an evaluation minus those of another, over the images that both have.

    Attributes:
        images: Number of these images.
        scores: Differences of the scores by name, if they are defined.
        intervals: 95 % bootstrap intervals of the differences, see `metrics.image_sums`.
    """

    images: int
    scores: Mapping[str, float]
    intervals: Mapping[str, Interval]


def difference(result: EvaluationResult, base: EvaluationResult) -> Difference | str:
    """Return the difference of an evaluation from another, or the reason why it is unknown.

    Args:
        result: The evaluation.
        base: Evaluation whose scores are subtracted; its images have the same names.
    """
    for name in ("data", "absent_class"):
        if result.protocol.get(name) != base.protocol.get(name):
            return f"their {name} differs"
    try:
        files = [dict(np.load(of.folder / SUMS_FILE)) for of in (result, base)]
    except OSError:
        return f"{SUMS_FILE} is missing: evaluate again"
    common, *places = np.intersect1d(*(sums.pop("images") for sums in files), return_indices=True)
    if not common.size:
        return "no image in common"
    absent, shared = base.protocol.get("absent_class", "skip"), zip(files, places, strict=True)
    pair = [{name: values[of] for name, values in sums.items()} for sums, of in shared]
    means, drawn = ([score(of, absent) for of in pair] for score in (means_of_sums, drawn_scores))
    defined = {name: score for name, score in _minus(*means).items() if not np.isnan(score)}
    return Difference(len(common), defined, intervals(_minus(*drawn)))


def _minus(scores: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    return {name: scores[name] - others[name] for name in scores.keys() & others.keys()}
