"""Rows of a report: mean and spread of evaluations that differ only in fold and seed.

A score of a row is first averaged over the seeds of each fold, then over the folds, like the
paper's "averaged over the 3 folds". Two spreads are sample standard deviations: over the means of
the folds (difference between folds), and over seeds, pooled over folds with several seeds
(repeatability of training).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean, stdev
from typing import Any, NamedTuple

from tangent_train.errors import DataError
from tangent_train.metrics.score_columns import SOLID_ANGLE
from tangent_train.metrics.segmentation import Interval
from tangent_train.results.evaluation_result import RESULTS_FILE, Band, EvaluationResult

Part = str | Band | None
"""Name of a class, or a latitude band; None for all images."""

_IGNORED = (
    *("choices", "checkpoint", "checkpoint_every_n_steps", "logger", "panels", "resume", "trust"),
    *("validation_images", "seed", "data.fold", "data.seed", "data.root", "data.label_table"),
    *("data.cache", "data.in_memory", "data.num_workers"),
    *("task.channels_last", "task.compile", "task.eval_view_batch_size"),
    *("trainer.accelerator", "trainer.enable_model_summary", "trainer.enable_progress_bar"),
    *("trainer.log_every_n_steps", "trainer.num_sanity_val_steps", "trainer.strategy"),
)
"""Settings, or sections, in which the runs of a row may differ: fold, seed, paths, speed."""


class Score(NamedTuple):
    """A score of one run, a share of 1 or in the unit of its column."""

    fold: int | None
    seed: int | None
    name: str
    part: Part
    value: float


class Statistic(NamedTuple):
    """A score over folds and seeds.

    Attributes:
        mean: Mean over the means of folds; None if no run has the score.
        over_folds: Standard deviation of the means of folds; None with one fold.
        over_seeds: Pooled standard deviation within folds; None with one seed per fold.
        folds: Number of folds with the score: a class may be absent from a fold.
        interval: 95 % bootstrap interval over the images of a single run; None with several runs.
    """

    mean: float | None
    over_folds: float | None
    over_seeds: float | None
    folds: int
    interval: Interval | None = None


@dataclass(frozen=True)
class RunRow:
    """Scores of evaluations that differ only in fold and seed.

    Attributes:
        label: Name of the row.
        scores: Scores of all evaluations.
        facts: Further columns of the tables, by title.
        results: Evaluations; empty for published scores.
        partner: Row that the scores are compared with.
    """

    label: str
    scores: Sequence[Score]
    facts: Mapping[str, str] = field(default_factory=dict)
    results: Sequence[EvaluationResult] = ()
    partner: RunRow | None = None

    @classmethod
    def of(
        cls, label: str, results: Iterable[EvaluationResult], facts: Mapping[str, str]
    ) -> RunRow:
        """Return the row of some evaluations, sorted by fold and seed."""
        ordered = sorted(results, key=lambda r: (r.fold or 0, r.seed or 0, str(r.folder)))
        return cls(label, [score for r in ordered for score in _scores(r)], facts, ordered)

    @property
    def is_published(self) -> bool:
        """True for published scores, whose labels end in "(paper)"."""
        return self.label.endswith("(paper)")

    @property
    def folds(self) -> tuple[int | None, ...]:
        """Folds of the scores; a single None for data without folds."""
        folds = dict.fromkeys(score.fold for score in self.scores)
        return tuple(fold for fold in folds if fold is not None) or (None,)

    @property
    def bands(self) -> list[Band]:
        """Latitude bands of the scores."""
        parts = dict.fromkeys(score.part for score in self.scores)
        return [part for part in parts if isinstance(part, tuple)]

    @cached_property
    def _grouped(self) -> Mapping[tuple[str, Part], list[Score]]:
        groups: dict[tuple[str, Part], list[Score]] = defaultdict(list)
        for score in self.scores:
            groups[score.name, score.part].append(score)
        return groups

    def _select(self, name: str, part: Part, fold: int | None) -> list[Score]:
        found = self._grouped.get((name, part), [])
        return [score for score in found if fold in (None, score.fold)]

    def score(self, name: str, part: Part = None, fold: int | None = None) -> Statistic:
        """Return the mean over folds of the mean over seeds, with spreads, or one run's interval.

        Args:
            name: Name of the score.
            part: Part of the images.
            fold: A single fold; None for all.
        """
        statistic = average((s.fold, s.value) for s in self._select(name, part, fold))
        if part is None and len(self.results) == 1:
            return statistic._replace(interval=self.results[0].intervals.get(name))
        return statistic

    def ratio(self, name: str, part: Part = None, fold: int | None = None) -> float | None:
        """Return the ratio of the mean to that of the partner, over folds and seeds of both.

        Pixels of photos cover nearly equal solid angles, so that scores of panoramas by solid angle
        are compared with scores of photos by pixels.

        Args:
            name: Name of the score.
            part: Part of the images.
            fold: A single fold; None for all.

        Returns:
            Ratio; None without a partner, or if the partner's score is undefined or 0.
        """
        if self.partner is None:
            return None
        by_pixels = name.removesuffix(SOLID_ANGLE)
        partner = self.partner._select(name, part, fold)
        partner = partner or self.partner._select(by_pixels, part, fold)
        bases = {(s.fold, s.seed): s.value for s in partner}
        pairs = [
            (s.fold, s.value, bases[s.fold, s.seed])
            for s in self._select(name, part, fold)
            if (s.fold, s.seed) in bases
        ]
        mean = average((fold, value) for fold, value, _ in pairs).mean
        base = average((fold, value) for fold, _, value in pairs).mean
        return mean / base if mean is not None and base else None


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


def _scores(result: EvaluationResult) -> Iterator[Score]:
    """Yield the defined scores of an evaluation."""
    parts: list[tuple[Part, Mapping[str, Any]]] = [(None, result.scores)]
    parts += [(entry["class"], entry) for entry in result.classes]
    parts += [(tuple(entry["latitude_deg"]), entry) for entry in result.latitude_bands]
    for part, entry in parts:
        for name in dict.fromkeys((*result.columns, *result.class_means)):
            if (value := entry.get(name)) is not None:
                yield Score(result.fold, result.seed, name, part, value)


def check_alike(results: Sequence[EvaluationResult]) -> None:
    """Check that evaluations have the same scores and the same classes.

    Raises:
        DataError: Scores or classes differ.
    """
    contents = [(*result.columns, *result.class_names) for result in results]
    for result, names in zip(results, contents, strict=True):
        if names != contents[0]:
            raise DataError(
                result.folder / RESULTS_FILE,
                found=f"scores and classes {', '.join(names)}",
                expected=f"{', '.join(contents[0])}, as in {results[0].folder / RESULTS_FILE}",
                remedy="Report them separately.",
            )


def group_results(results: Sequence[EvaluationResult]) -> dict[str, list[EvaluationResult]]:
    """Group evaluations that differ only in fold and seed.

    Args:
        results: Results of finished runs, with their settings.

    Returns:
        Groups in the order of their first runs, by label: the name of the runs, and the settings by
        which they differ from groups of the same name.
    """
    groups: list[tuple[dict[str, Any], list[EvaluationResult]]] = []
    for result in results:
        identity = _identity(result)
        members = next((members for other, members in groups if other == identity), None)
        if members is None:
            groups.append((identity, [result]))
        else:
            members.append(result)
    for identity, members in groups:
        identity.setdefault("name", members[0].folder.name)
    identities = [identity for identity, _ in groups]
    return {_label(identity, identities): members for identity, members in groups}


def _identity(result: EvaluationResult) -> dict[str, Any]:
    """Return the settings that are equal in all runs of a row."""
    ignored = tuple(f"{name}." for name in _IGNORED)
    # A network without settings is identified by its file.
    network = {"checkpoint": result.checkpoint} if "network" in result.settings else {}
    return network | {
        # Each fold is fine-tuned from a different checkpoint.
        name: True if name == "init_from" else value
        for name, value in result.settings.items()
        if value is not None and not f"{name}.".startswith(ignored)
    }


def _label(identity: Mapping[str, Any], identities: Sequence[Mapping[str, Any]]) -> str:
    """Return the name of runs with the settings that differ."""
    others = [other for other in identities if other["name"] == identity["name"]]
    names = sorted({name for other in others for name in other})
    names = [n for n in names if any(_is_different(n, identity, other) for other in others)]
    text = ", ".join(_setting_text(name, identity.get(name)) for name in names)
    return str(identity["name"]) + f" ({text})" * bool(text)


def _is_different(name: str, first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Return True if a setting differs, but not the class of its section."""
    target = f"{name.rpartition('.')[0]}._target_"
    is_comparable = name == target or first.get(target) == second.get(target)
    return is_comparable and first.get(name) != second.get(name)


def _setting_text(name: str, value: Any) -> str:
    """Return a setting as text; a class without its module."""
    section = name.removesuffix("._target_")
    return f"{section}={value if section == name else str(value).rpartition('.')[2]}"
