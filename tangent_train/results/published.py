"""Published scores, beside results of the same protocol.

``published.csv`` contains published scores with their sources, one score per line, and those of
single classes of Stanford2D3DS: in percent, or in the unit of the score, see `ScoreColumn`.
``protocols.yaml`` contains the facts that make scores
comparable (`LabeledData.facts`, `Task.facts`), for each ``protocol`` of the scores. A score
stands beside a result if all facts are the same; else the facts that differ are named.

Of the paper (Eder, Shvets, Lim and Frahm, CVPR 2020, arXiv:1912.09390), the file contains the
tables of semantic segmentation, shape classification and network transfer, and the per-class
tables of the supplement. Lines with a ``stage`` belong to the transfer: they are the single folds,
because the paper's rows for all folds repeat fold 3; scores per class are over all folds.
"""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from statistics import fmean
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped]

from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.rows import Row
from tangent_train.results.tables import Table, score_text

_NOT_FACTS = ("about", "experiment")
_MOST_NAMED = 3


class Publication(NamedTuple):
    """The lines of a method in ``published.csv``; the other attributes are their common columns."""

    protocol: str
    stage: str
    method: str
    trained_on: str
    level: str
    base_level: str
    inputs: str
    source: str
    lines: Sequence[Mapping[str, str]]

    @property
    def name(self) -> str:
        """Name of the method, with the stage of the transfer and the training data."""
        method = "" if self.stage and self.method == "tangent images" else self.method
        trained = self.trained_on and f"trained on {self.trained_on}"
        return ", ".join(filter(None, (method, self.stage, trained)))

    def scores(self, name: str) -> list[float]:
        """Return a score of the folds, in the unit of the file."""
        return [
            float(line["mean"]) for line in self.lines if line["score"] == name and line["mean"]
        ]

    @property
    def folds(self) -> tuple[str, ...]:
        """Folds with a score; empty for means over all folds."""
        return tuple(dict.fromkeys(line["fold"] for line in self.lines if line["fold"]))

    def differences(self, record: EvaluationResult) -> tuple[str, ...]:
        """Return the facts that differ from those of an evaluation, with both values."""
        published, found = facts(self.protocol), dict(record.protocol)
        found.pop("views_aligned", None)  # of the method
        if self.level:
            published["level"], found["level"] = self.level, str(record.settings.get("level"))
        if self.folds and record.fold is not None and str(record.fold) not in self.folds:
            published["fold"], found["fold"] = ", ".join(self.folds), str(record.fold)
        pairs = {n: (published.get(n, "–"), found.get(n, "–")) for n in {**published, **found}}
        return tuple(f"{n}: published {p}, this run {r}" for n, (p, r) in pairs.items() if p != r)

    def row(self, like: EvaluationResult, shown: Sequence[str] = ()) -> Row:
        """Return a row with the headings and classes of an evaluation.

        Args:
            like: Evaluation.
            shown: Facts of the protocol that are columns of the tables.
        """
        folds: dict[str, dict[str, Mapping[str, str]]] = defaultdict(dict)
        for line in self.lines:
            folds[line["fold"]][line["score"]] = line
        records = tuple(_record(like, fold, by_score) for fold, by_score in folds.items())
        protocol = facts(self.protocol)
        columns = {
            "data": protocol["data"],
            "s": self.level or "–",
            "input": self.inputs or "–",
            "b": self.base_level or "–",
            "folds": ", ".join(self.folds) or "–",
            **{name: protocol.get(name, "–") for name in shown},
        }
        return Row(f"{self.name} (paper)", records, columns, published=True)


class Comparison(NamedTuple):
    """Published scores for some evaluations.

    Attributes:
        rows: Scores of the same protocol.
        notes: Sources of these, and the differences of the nearest other protocols.
    """

    rows: list[Row]
    notes: list[str]

    @staticmethod
    def of(
        records: Sequence[EvaluationResult], *, transfer: bool = False, shown: Sequence[str] = ()
    ) -> Comparison:
        """Compare evaluations with the published scores on their data sets.

        Args:
            records: Evaluations with the same scores.
            transfer: True for scores of networks that were trained on other data.
            shown: Facts of the protocols that are columns of the tables.
        """
        groups: dict[tuple[str, ...], list[Publication]] = defaultdict(list)
        for publication in publications():
            stage, data = publication.stage, facts(publication.protocol)["data"]
            names = {line["score"] for line in publication.lines}
            on_data = [r for r in records if r.protocol.get("data") == data and names & {*r.scores}]
            if on_data and (stage or publication.trained_on if transfer else not stage):
                groups[min(map(publication.differences, on_data), key=len)].append(publication)
        same = groups.pop((), [])
        sources = ", ".join(dict.fromkeys(publication.source for publication in same))
        notes = [f"Published scores of the same protocol: {sources}."] if same else []
        nearest = sorted(groups, key=len)[:_MOST_NAMED]
        notes += [_difference(groups[some], some, records[0]) for some in nearest]
        return Comparison([publication.row(records[0], shown) for publication in same], notes)

    def tables(self, like: EvaluationResult) -> list[Table]:
        """Return a table of the rows for one evaluation, or nothing without rows.

        Args:
            like: Evaluation with the headings and the fold.
        """
        rows = [row.of_fold(like.fold) if like.fold in row.folds else row for row in self.rows]
        names = [n for n in like.columns if any(r.score(n).mean is not None for r in rows)]
        cells = [
            (
                row.label,
                row.facts["input"],
                *(score_text(row.score(name).mean, like.columns[name].unit) for name in names),
            )
            for row in rows
        ]
        header = ("", "input", *(like.columns[name].title for name in names))
        table = Table("Published, same protocol", header, cells, text_columns=(0, 1))
        return [table] if rows else []


def _difference(
    group: Sequence[Publication], differences: Sequence[str], record: EvaluationResult
) -> str:
    """Return a sentence on published scores with the same differences from an evaluation."""
    sign = -1 if record.columns[record.main].better == "lower" else 1
    named = [(publication.scores(record.main), publication) for publication in group]
    scores, best = max(named, key=lambda pair: fmean([sign * s for s in pair[0]] or [-math.inf]))
    text = ", ".join(f"{score:g}" for score in scores)
    more = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return f"Not comparable: {best.name}: {text}{more} ({best.protocol}). {'; '.join(differences)}."


@cache
def protocols() -> Mapping[str, Mapping[str, Any]]:
    """Return the protocols by name: their facts, ``about`` and, if there is one, ``experiment``."""
    content: dict[str, Any] = yaml.safe_load(_read("protocols.yaml"))
    return {name: entry for name, entry in content.items() if not name.startswith("_")}


def facts(protocol: str) -> dict[str, str]:
    """Return the facts of a protocol by name."""
    entry = protocols()[protocol]
    return {name: str(value) for name, value in entry.items() if name not in _NOT_FACTS}


@cache
def publications() -> tuple[Publication, ...]:
    """Return the methods of ``published.csv``, in the order of the file."""
    groups: dict[tuple[str, ...], list[dict[str, str]]] = defaultdict(list)
    for line in published_lines():
        groups[tuple(line[name] for name in Publication._fields[:-1])].append(line)
    return tuple(Publication._make([*key, lines]) for key, lines in groups.items())


def published_lines() -> Iterator[dict[str, str]]:
    """Yield the lines of ``published.csv``."""
    yield from csv.DictReader(_read("published.csv").splitlines())


def _read(name: str) -> str:
    return files("tangent_train.results").joinpath(name).read_text(encoding="utf-8")


def _record(
    like: EvaluationResult, fold: str, by_score: Mapping[str, Mapping[str, str]]
) -> EvaluationResult:
    def value(score: str, column: str) -> float | None:
        text = by_score.get(score, {}).get(column)
        whole = 100 if like.columns[score].unit == "%" else 1
        return round(float(text) / whole, 6) if text else None

    classes = [
        {"class": c, **{name: value(mean, c) for name, mean in like.class_means.items()}}
        for c in like.class_names
    ]
    means = {name: value(name, "mean") for name in like.scores}
    settings = {"data.fold": int(fold) if fold else None}
    return EvaluationResult("", 0, like.columns, means, classes, settings=settings)
