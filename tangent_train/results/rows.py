"""Rows of a report: mean and spread of evaluations that differ only in fold and seed.

A score of a row is first averaged over the seeds of each fold, then over the folds, like the
paper's "averaged over the 3 folds". Two spreads are sample standard deviations: over the means of
the folds (difference between folds), and over seeds, pooled over folds with several seeds
(repeatability of training).
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, stdev
from typing import Any, NamedTuple

from tangent_train.config.setting_rules import may_differ
from tangent_train.errors import DataError
from tangent_train.metrics.score_columns import SOLID_ANGLE
from tangent_train.metrics.segmentation import Interval
from tangent_train.results.evaluation_result import RESULTS_FILE, Band, EvaluationResult


class Statistic(NamedTuple):
    """A score over folds and seeds, a share of 1.

    Attributes:
        mean: Mean over the means of folds; None if no run has the score.
        over_folds: Standard deviation of the means of folds; None with one fold.
        over_seeds: Pooled standard deviation within folds; None with one seed per fold.
        folds: Number of folds with the score: a class may be absent from a fold.
        low: Lower end of the 95 % bootstrap interval over the images of a single run; None with
            several runs.
        high: Upper end of that interval.
    """

    mean: float | None
    over_folds: float | None
    over_seeds: float | None
    folds: int
    low: float | None = None
    high: float | None = None

    @property
    def interval(self) -> Interval | None:
        """The 95 % interval; None with several runs."""
        return None if self.low is None or self.high is None else (self.low, self.high)


@dataclass(frozen=True)
class Row:
    """Evaluations that differ only in fold and seed.

    Attributes:
        label: Name of the row.
        records: Records of the evaluations.
        facts: Further columns of the tables, by heading.
        partner: Row that the scores are compared with.
        published: True if the scores are from a paper.
    """

    label: str
    records: tuple[EvaluationResult, ...]
    facts: Mapping[str, str] = field(default_factory=dict)
    partner: Row | None = None
    published: bool = False

    @property
    def folds(self) -> tuple[int | None, ...]:
        """Folds of the records; a single None for data without folds."""
        folds = dict.fromkeys(record.fold for record in self.records)
        return tuple(fold for fold in folds if fold is not None) or (None,)

    @property
    def bands(self) -> tuple[Band, ...]:
        """Latitude bands of the records."""
        return tuple(dict.fromkeys(band for record in self.records for band in record.bands))

    def of_fold(self, fold: int | None) -> Row:
        """Return the row with the records of one fold, also in the partner."""
        records = tuple(record for record in self.records if record.fold == fold)
        partner = None if self.partner is None else self.partner.of_fold(fold)
        return replace(self, records=records, partner=partner)

    def score(self, name: str, part: str | Band | None = None) -> Statistic:
        """Return the mean over folds of the mean over seeds, with spreads, or one run's interval.

        Args:
            name: Name of the score.
            part: Name of a class, or a band; None for all images.
        """
        statistic = average((fold, value) for (fold, _), value in self._values(name, part))
        if part is not None or len(self.records) != 1:
            return statistic
        low, high = self.records[0].intervals.get(name, (None, None))
        return statistic._replace(low=low, high=high)

    def kept(self, name: str, part: str | Band | None = None) -> Statistic:
        """Return the ratio of a score to that of the partner, over folds and seeds of both.

        The mean is the ratio of the two means; the spreads are those of the single ratios. Pixels
        of photos cover nearly equal solid angles, so that scores of panoramas by solid angle are
        compared with scores of photos by pixels.

        Args:
            name: Name of the score.
            part: Name of a class, or a band; None for all images.

        Returns:
            Ratio; its mean is None without a partner, or if the partner's score is undefined or 0.
        """
        if self.partner is None:
            return average([])
        by_pixels = name.removesuffix(SOLID_ANGLE)
        bases = dict(self.partner._values(name, part) or self.partner._values(by_pixels, part))
        pairs = [(k[0], value, bases[k]) for k, value in self._values(name, part) if k in bases]
        base_mean = average((fold, base) for fold, _, base in pairs).mean
        if not base_mean:
            return average([])
        ratios = average((fold, value / base) for fold, value, base in pairs if base)
        mean = average((fold, value) for fold, value, _ in pairs).mean
        return ratios._replace(mean=None if mean is None else mean / base_mean)

    def _values(
        self, name: str, part: str | Band | None
    ) -> list[tuple[tuple[int | None, int | None], float]]:
        """Return the defined scores of the records, with fold and seed."""
        scores = (((r.fold, r.seed), r.score(name, part)) for r in self.records)
        return [(key, value) for key, value in scores if value is not None]


def average(values: Iterable[tuple[int | None, float]]) -> Statistic:
    """Compute the mean over folds of the mean over seeds, with both spreads.

    Args:
        values: Fold and score of each run that has the score.

    >>> average([(1, 0.25), (1, 0.75), (2, 1.0)]).mean
    0.75
    """
    folds: dict[int | None, list[float]] = defaultdict(list)
    for fold, value in values:
        folds[fold].append(value)
    means = [fmean(scores) for scores in folds.values()]
    several = [scores for scores in folds.values() if len(scores) > 1]
    freedom = sum(len(scores) - 1 for scores in several)
    squares = sum((len(scores) - 1) * stdev(scores) ** 2 for scores in several)
    return Statistic(
        mean=fmean(means) if means else None,
        over_folds=stdev(means) if len(means) > 1 else None,
        over_seeds=(squares / freedom) ** 0.5 if freedom else None,
        folds=len(means),
    )


def check_alike(records: Sequence[EvaluationResult]) -> None:
    """Check that evaluations have the same scores and the same classes.

    Raises:
        DataError: Scores or classes differ.
    """
    first = records[0]
    for record in records:
        if (record.columns, record.class_names) != (first.columns, first.class_names):
            raise DataError(
                record.folder / RESULTS_FILE,
                found=_contents(record),
                expected=f"{_contents(first)}, the contents of {first.folder / RESULTS_FILE}",
                remedy="Report them separately.",
            )


def _contents(record: EvaluationResult) -> str:
    classes = f", classes {', '.join(record.class_names)}" * bool(record.classes)
    return f"scores {', '.join(record.columns)}{classes}"


def group_runs(records: Sequence[EvaluationResult]) -> list[Row]:
    """Group evaluations that differ only in fold and seed.

    Args:
        records: Records of finished runs, with their settings.

    Returns:
        Rows in the order of their first runs. Their labels are the names of the runs, and the
        settings by which they differ from rows of the same name.

    Raises:
        DataError: The runs have different scores or classes.
    """
    check_alike(records)
    members: dict[str, list[EvaluationResult]] = defaultdict(list)
    for record in records:
        members[json.dumps(_identity(record), sort_keys=True, default=str)].append(record)
    labels = _labels([group[0] for group in members.values()])
    return [
        Row(label, tuple(sorted(group, key=lambda r: (r.fold or 0, r.seed or 0, str(r.folder)))))
        for label, group in zip(labels, members.values(), strict=True)
    ]


def _identity(record: EvaluationResult) -> dict[str, Any]:
    """Return the settings that are equal in all runs of a row."""
    # A network without settings is identified by its file.
    network = {"checkpoint": record.checkpoint} if "network" in record.settings else {}
    return network | {
        # Each fold is fine-tuned from a different checkpoint.
        name: True if name == "init_from" else value
        for name, value in record.settings.items()
        if value is not None and not may_differ(name, "report")
    }


def _labels(firsts: Sequence[EvaluationResult], shown: int | None = 3) -> list[str]:
    """Return names with the settings that differ: the first few, or all if they are needed."""
    labels = []
    for record in firsts:
        settings = _identity(record)
        others = [o for o in map(_identity, firsts) if o.get("name") == settings.get("name")]
        differing = [
            _short_setting(name, settings.get(name))
            for name in sorted({key for other in others for key in other})
            if any(_differs(name, other, settings) for other in others)
        ]
        text = ", ".join(differing[:shown]) + ", …" * (len(differing) > (shown or len(differing)))
        name = str(settings.get("name") or record.folder.name)
        labels.append(name + (f" ({text})" if text else ""))
    is_clear = shown is None or len(set(labels)) == len(labels)
    return labels if is_clear else _labels(firsts, None)


def _differs(setting: str, first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Return True if a setting differs, but not the class of its section."""
    classes = [
        name
        for name in first.keys() | second.keys()
        if name.endswith("._target_") and setting.startswith(name.removesuffix("_target_"))
    ]
    is_same_class = all(first.get(name) == second.get(name) for name in classes if name != setting)
    return is_same_class and first.get(setting) != second.get(setting)


def _short_setting(setting: str, value: Any) -> str:
    """Return a setting as text; a class without its module."""
    section = setting.removesuffix("._target_")
    return f"{section}={value if section == setting else str(value).rpartition('.')[2]}"
