"""Rows of a report: mean and spread of evaluations that differ only in fold and seed.

A score of a row is first averaged over the seeds of each fold, then over the folds, like the
paper's "averaged over the 3 folds". Two spreads are sample standard deviations: over the means of
the folds (difference between folds), and over seeds, pooled over folds with several seeds
(repeatability of training).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, stdev
from typing import Any, NamedTuple

from tangent_train.errors import DataError
from tangent_train.metrics.scores import SOLID_ANGLE, Interval
from tangent_train.results.evaluation import RESULTS_FILE, Band, EvaluationResult
from tangent_train.results.paired import Difference

Part = str | Band | None
"""Name of a class, or a latitude band; None for all images."""

Value = tuple[int | None, int | None, float]
"""Fold, seed and score of one run."""

_IGNORED = (
    *("choices", "checkpoint", "checkpoint_every_n_steps", "logger", "panels", "resume", "trust"),
    *("validation_images", "seed", "data.fold", "data.seed", "data.root", "data.label_table"),
    *("data.cache", "data.in_memory", "data.num_workers"),
    *("task.channels_last", "task.compile", "task.eval_view_batch_size"),
    *("trainer.accelerator", "trainer.enable_model_summary", "trainer.enable_progress_bar"),
    *("trainer.log_every_n_steps", "trainer.num_sanity_val_steps", "trainer.strategy"),
)
"""Settings, or sections, in which the runs of a row may differ: fold, seed, paths, speed."""


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

    @classmethod
    def of(cls, values: Iterable[Value]) -> Statistic:
        """Return the mean over folds of the mean over seeds, with both spreads.

        >>> Statistic.of([(1, 0, 0.25), (1, 1, 0.75), (2, 0, 1.0)]).mean
        0.75
        """
        folds: dict[int | None, list[float]] = defaultdict(list)
        for fold, _, value in values:
            folds[fold].append(value)
        means = [fmean(scores) for scores in folds.values()]
        squares = [(score - fmean(some)) ** 2 for some in folds.values() for score in some]
        freedom = len(squares) - len(means)
        return cls(
            mean=fmean(means) if means else None,
            over_folds=stdev(means) if len(means) > 1 else None,
            over_seeds=(sum(squares) / freedom) ** 0.5 if freedom else None,
            folds=len(means),
        )


@dataclass(frozen=True)
class RunRow:
    """Scores of evaluations that differ only in fold and seed.

    Attributes:
        label: Name of the row; that of published scores ends in "(paper)".
        scores: Fold, seed and value of each evaluation, by name of the score and part; a value is a
            share of 1, or in the unit of its column.
        facts: Further columns of the tables, by title.
        results: Evaluations; empty for published scores.
        partner: Row that the scores are compared with.
        difference: Difference of a single run from another, over the images that both have.
    """

    label: str
    scores: Mapping[tuple[str, Part], Sequence[Value]]
    facts: Mapping[str, str] = field(default_factory=dict)
    results: Sequence[EvaluationResult] = ()
    partner: RunRow | None = None
    difference: Difference | None = None

    @classmethod
    def of(
        cls, label: str, results: Iterable[EvaluationResult], facts: Mapping[str, str]
    ) -> RunRow:
        """Return the row of some evaluations, sorted by fold and seed."""
        ordered = sorted(results, key=lambda r: (r.fold or 0, r.seed or 0, str(r.folder)))
        scores: dict[tuple[str, Part], list[Value]] = defaultdict(list)
        for r in ordered:
            parts: list[tuple[Part, Mapping[str, Any]]] = [(None, r.scores)]
            parts += [(entry["class"], entry) for entry in r.classes]
            parts += [(tuple(entry["latitude_deg"]), entry) for entry in r.latitude_bands]
            for part, entry in parts:
                for name in dict.fromkeys((*r.columns, *r.class_means)):
                    if (value := entry.get(name)) is not None:
                        scores[name, part].append((r.fold, r.seed, value))
        return cls(label, scores, facts, ordered)

    @property
    def folds(self) -> tuple[int | None, ...]:
        """Folds of the scores; a single None for data without folds."""
        folds = {fold for values in self.scores.values() for fold, *_ in values}
        return tuple(sorted(fold for fold in folds if fold is not None)) or (None,)

    @property
    def bands(self) -> list[Band]:
        """Latitude bands of the scores."""
        return [
            part for part in dict.fromkeys(p for _, p in self.scores) if isinstance(part, tuple)
        ]

    def score(self, name: str, part: Part = None, fold: int | None = None) -> Statistic:
        """Return the mean over folds of the mean over seeds, with spreads, or one run's interval.

        Args:
            name: Name of the score.
            part: Part of the images.
            fold: A single fold; None for all.
        """
        is_single = part is None and len(self.results) == 1
        interval = self.results[0].intervals.get(name) if is_single else None
        values = self.scores.get((name, part), ())
        return Statistic.of(value for value in values if fold in (None, value[0]))._replace(
            interval=interval
        )

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
        mine, scores = self.scores.get((name, part), ()), self.partner.scores
        others = scores.get((name, part)) or scores.get((name.removesuffix(SOLID_ANGLE), part), ())
        shared = {value[:2] for value in mine} & {value[:2] for value in others}
        mean, base = (
            Statistic.of(v for v in values if v[:2] in shared and fold in (None, v[0])).mean
            for values in (mine, others)
        )
        return mean / base if mean is not None and base else None


def check_alike(results: Sequence[EvaluationResult]) -> None:
    """Check that evaluations have the same scores and the same classes.

    Raises:
        DataError: Scores or classes differ.
    """
    first, *others = ((r.folder / RESULTS_FILE, [*r.columns, *r.class_names]) for r in results)
    for path, names in others:
        if names != first[1]:
            raise DataError(
                path,
                found=f"scores and classes {', '.join(names)}",
                expected=f"{', '.join(first[1])}, as in {first[0]}",
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
    groups: dict[str, list[EvaluationResult]] = defaultdict(list)
    for result in results:
        groups[repr(sorted(_identity(result).items()))].append(result)
    identities = [{"name": some[0].folder.name} | _identity(some[0]) for some in groups.values()]
    labels = [_label(identity, identities) for identity in identities]
    return dict(zip(labels, groups.values(), strict=True))


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
    """Return the name of runs with the settings that differ; of a section, only its class."""
    others = [other for other in identities if other["name"] == identity["name"]]
    texts = []
    for name in sorted({name for other in others for name in other}):
        section, _, key = name.rpartition(".")
        target, value = f"{section}._target_", identity.get(name)
        if any(
            value != other.get(name)
            and (key == "_target_" or identity.get(target) == other.get(target))
            for other in others
        ):
            is_class = key == "_target_"  # without its module
            shown = (section, str(value).rpartition(".")[2]) if is_class else (name, value)
            texts.append("{}={}".format(*shown))
    return str(identity["name"]) + f" ({', '.join(texts)})" * bool(texts)
