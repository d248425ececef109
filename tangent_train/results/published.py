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
from tangent_train.results.rows import RunRow, Score
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

    def differences(self, result: EvaluationResult) -> tuple[str, ...]:
        """Return the facts that differ from those of an evaluation, with both values."""
        published, found = facts(self.protocol), dict(result.protocol)
        found.pop("views_aligned", None)  # of the method
        if self.level:
            published["level"], found["level"] = self.level, str(result.settings.get("level"))
        if self.folds and result.fold is not None and str(result.fold) not in self.folds:
            published["fold"], found["fold"] = ", ".join(self.folds), str(result.fold)
        pairs = {n: (published.get(n, "–"), found.get(n, "–")) for n in {**published, **found}}
        return tuple(f"{n}: published {p}, this run {r}" for n, (p, r) in pairs.items() if p != r)

    def row(self, like: EvaluationResult, shown: Sequence[str] = ()) -> RunRow:
        """Return a row with the scores and classes of an evaluation.

        Args:
            like: Evaluation.
            shown: Facts of the protocol that are columns of the tables.
        """
        of_class = {mean: name for name, mean in like.class_means.items()}
        scores = []
        for line in self.lines:
            fold, mean = int(line["fold"]) if line["fold"] else None, line["score"]
            parts: list[tuple[str | None, str, str | None]] = []
            if mean in like.columns:
                parts.append((None, mean, line["mean"]))
            if mean in of_class:
                parts += [(name, of_class[mean], line.get(name)) for name in like.class_names]
            for part, name, text in parts:
                if text:
                    whole = 100 if like.columns[mean].unit == "%" else 1
                    scores.append(Score(fold, None, name, part, round(float(text) / whole, 6)))
        protocol = facts(self.protocol)
        columns = {
            "data": protocol["data"],
            "s": self.level or "–",
            "input": self.inputs or "–",
            "b": self.base_level or "–",
            "folds": ", ".join(self.folds) or "–",
            **{name: protocol.get(name, "–") for name in shown},
        }
        return RunRow(f"{self.name} (paper)", scores, columns)


def published_rows(
    results: Sequence[EvaluationResult], *, transfer: bool = False, shown: Sequence[str] = ()
) -> tuple[list[RunRow], list[str]]:
    """Compare evaluations with the published scores on their data sets.

    Args:
        results: Evaluations with the same scores.
        transfer: True for scores of networks that were trained on other data.
        shown: Facts of the protocols that are columns of the tables.

    Returns:
        Rows of the published scores of the same protocol, and notes on their sources and on the
        differences of the nearest other protocols.
    """
    groups: dict[tuple[str, ...], list[Publication]] = defaultdict(list)
    for publication in publications():
        stage, data = publication.stage, facts(publication.protocol)["data"]
        names = {line["score"] for line in publication.lines}
        on_data = [r for r in results if r.protocol.get("data") == data and names & {*r.scores}]
        if on_data and (stage or publication.trained_on if transfer else not stage):
            groups[min(map(publication.differences, on_data), key=len)].append(publication)
    same = groups.pop((), [])
    sources = ", ".join(dict.fromkeys(publication.source for publication in same))
    notes = [f"Published scores of the same protocol: {sources}."] if same else []
    nearest = sorted(groups, key=len)[:_MOST_NAMED]
    notes += [_difference(groups[some], some, results[0]) for some in nearest]
    return [publication.row(results[0], shown) for publication in same], notes


def published_table(rows: Sequence[RunRow], like: EvaluationResult) -> Table:
    """Return a table of published scores for one evaluation.

    Args:
        rows: Rows of published scores.
        like: Evaluation with the scores and the fold.
    """

    def mean(row: RunRow, name: str) -> float | None:
        return row.score(name, fold=like.fold if like.fold in row.folds else None).mean

    columns = {
        name: column
        for name, column in like.columns.items()
        if any(mean(row, name) is not None for row in rows)
    }
    cells = [
        (
            *(row.label, row.facts["input"]),
            *(score_text(mean(row, name), column.unit) for name, column in columns.items()),
        )
        for row in rows
    ]
    header = ("", "input", *(column.title for column in columns.values()))
    return Table("Published, same protocol", header, cells, text_columns=(0, 1))


def _difference(
    group: Sequence[Publication], differences: Sequence[str], result: EvaluationResult
) -> str:
    """Return a sentence on published scores with the same differences from an evaluation."""
    sign = -1 if result.columns[result.main].better == "lower" else 1
    named = [(publication.scores(result.main), publication) for publication in group]
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
