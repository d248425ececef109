"""Rows of a report: evaluations alike but for fold and seed, as mean and spread.

A score of a row is first averaged over the seeds of each fold, then over the folds, as the paper's
"averaged over the 3 folds". Two spreads are sample standard deviations: over the folds' means
(difference between folds), and over seeds, pooled over the folds with several (repeatability of
training).
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, stdev
from typing import Any, NamedTuple

from tangent_train.errors import DataError
from tangent_train.metrics.segmentation import Interval
from tangent_train.results.record import RESULTS_FILE, SOLID_ANGLE, Band, Record
from tangent_train.setting_rules import may_differ


class Statistic(NamedTuple):
    """A score over folds and seeds, a share of 1.

    Attributes:
        mean: Over the folds' means; None where it is defined in no run.
        over_folds: Standard deviation of the folds' means; None with one fold.
        over_seeds: Pooled standard deviation within folds; None with one seed for each.
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
        """The interval, where there is one."""
        return None if self.low is None or self.high is None else (self.low, self.high)


@dataclass(frozen=True)
class Row:
    """Evaluations that differ only in fold and seed.

    Attributes:
        label: Name of the row.
        records: The evaluations.
        facts: Further columns of the tables, by heading.
        partner: The row that its scores are compared with.
        published: True if it is from a paper.
    """

    label: str
    records: tuple[Record, ...]
    facts: Mapping[str, str] = field(default_factory=dict)
    partner: Row | None = None
    published: bool = False

    @property
    def folds(self) -> tuple[int | None, ...]:
        """The folds it has; None alone for data without folds."""
        found = dict.fromkeys(record.fold for record in self.records)
        return tuple(fold for fold in found if fold is not None) or (None,)

    @property
    def bands(self) -> tuple[Band, ...]:
        """Its latitude bands."""
        return tuple(dict.fromkeys(band for record in self.records for band in record.bands))

    def of_fold(self, fold: int | None) -> Row:
        """Its part of a fold, with its partner's."""
        records = tuple(record for record in self.records if record.fold == fold)
        partner = None if self.partner is None else self.partner.of_fold(fold)
        return replace(self, records=records, partner=partner)

    def score(self, name: str, part: str | Band | None = None) -> Statistic:
        """Mean over folds of the mean over seeds, with both spreads; of one run, its interval.

        Args:
            name: Name of the score.
            part: Name of a class, or a band.
        """
        found = average((fold, value) for (fold, _), value in self._values(name, part))
        if part is not None or len(self.records) != 1:
            return found
        low, high = self.records[0].intervals.get(name, (None, None))
        return found._replace(low=low, high=high)

    def kept(self, name: str, part: str | Band | None = None) -> Statistic:
        """Return the ratio of its score to its partner's, over the folds and seeds that both have.

        The mean is the ratio of the two means, the spreads are those of the single ratios. Pixels
        of photos cover nearly the same solid angle: what panoramas score by solid angle is compared
        with what photos score by pixels.

        Args:
            name: Name of the score.
            part: Name of a class, or a band.

        Returns:
            None for the mean where there is no partner, or where its score is undefined or 0.
        """
        if self.partner is None:
            return average([])
        by_pixels = name.removesuffix(SOLID_ANGLE)
        base = dict(self.partner._values(name, part) or self.partner._values(by_pixels, part))
        pairs = [(key[0], own, base[key]) for key, own in self._values(name, part) if key in base]
        before = average((fold, base) for fold, _, base in pairs).mean
        if not before:
            return average([])
        ratios = average((fold, own / base) for fold, own, base in pairs if base)
        own = average((fold, own) for fold, own, _ in pairs).mean
        return ratios._replace(mean=None if own is None else own / before)

    def _values(
        self, name: str, part: str | Band | None
    ) -> list[tuple[tuple[int | None, int | None], float]]:
        found = (((r.fold, r.seed), r.score(name, part)) for r in self.records)
        return [(key, value) for key, value in found if value is not None]


def average(values: Iterable[tuple[int | None, float]]) -> Statistic:
    """Mean over folds of the mean over seeds, with both spreads.

    Args:
        values: Fold and score of each run that has the score.

    >>> average([(1, 0.25), (1, 0.75), (2, 1.0)]).mean
    0.75
    """
    of_fold: dict[int | None, list[float]] = defaultdict(list)
    for fold, value in values:
        of_fold[fold].append(value)
    means = [fmean(found) for found in of_fold.values()]
    several = [found for found in of_fold.values() if len(found) > 1]
    freedom = sum(len(found) - 1 for found in several)
    squares = sum((len(found) - 1) * stdev(found) ** 2 for found in several)
    return Statistic(
        mean=fmean(means) if means else None,
        over_folds=stdev(means) if len(means) > 1 else None,
        over_seeds=(squares / freedom) ** 0.5 if freedom else None,
        folds=len(means),
    )


def check_alike(records: Sequence[Record]) -> None:
    """Check that evaluations have the same scores and the same classes.

    Raises:
        DataError: They are not.
    """
    first = records[0]
    for record in records:
        if (record.headings, record.class_names) != (first.headings, first.class_names):
            raise DataError(
                record.folder / RESULTS_FILE,
                found=_contents(record),
                expected=f"{_contents(first)}, as in {first.folder / RESULTS_FILE}",
                remedy="Report them separately.",
            )


def _contents(record: Record) -> str:
    classes = f", classes {', '.join(record.class_names)}" * bool(record.classes)
    return f"scores {', '.join(record.headings)}{classes}"


def group_runs(records: Sequence[Record]) -> list[Row]:
    """Group evaluations that differ only in fold and seed.

    Args:
        records: Records of finished runs, with their settings.

    Returns:
        Rows in the order of their first runs, labelled with the names of the runs, and with the
        settings by which they differ from others of the same name.

    Raises:
        DataError: They have different classes.
    """
    check_alike(records)
    members: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        members[json.dumps(_identity(record), sort_keys=True, default=str)].append(record)
    labels = _labels([found[0] for found in members.values()])
    return [
        Row(label, tuple(sorted(found, key=lambda r: (r.fold or 0, r.seed or 0, str(r.folder)))))
        for label, found in zip(labels, members.values(), strict=True)
    ]


def _identity(record: Record) -> dict[str, Any]:
    # A network that no settings describe is the file's.
    network = {"checkpoint": record.checkpoint} if "network" in record.settings else {}
    return network | {
        # Each fold is fine-tuned from a checkpoint of its own.
        name: True if name == "init_from" else value
        for name, value in record.settings.items()
        if value is not None and not may_differ(name, "report")
    }


def _labels(firsts: Sequence[Record], shown: int | None = 3) -> list[str]:
    """Names with the settings that differ: the first few, or all if these are not enough."""
    labels = []
    for record in firsts:
        own = _identity(record)
        others = [o for o in map(_identity, firsts) if o.get("name") == own.get("name")]
        differing = [
            _in_short(setting, own.get(setting))
            for setting in sorted({key for other in others for key in other})
            if any(_differs(setting, other, own) for other in others)
        ]
        text = ", ".join(differing[:shown]) + ", …" * (len(differing) > (shown or len(differing)))
        labels.append(str(own.get("name") or record.folder.name) + (f" ({text})" if text else ""))
    is_clear = shown is None or len(set(labels)) == len(labels)
    return labels if is_clear else _labels(firsts, None)


def _differs(setting: str, other: Mapping[str, Any], own: Mapping[str, Any]) -> bool:
    """Return True if a setting differs, and not only because its section is of another class."""
    classes = [
        name
        for name in own.keys() | other.keys()
        if name.endswith("._target_") and setting.startswith(name.removesuffix("_target_"))
    ]
    alike = all(other.get(name) == own.get(name) for name in classes if name != setting)
    return alike and other.get(setting) != own.get(setting)


def _in_short(setting: str, value: Any) -> str:
    section = setting.removesuffix("._target_")
    return f"{section}={value if section == setting else str(value).rpartition('.')[2]}"
