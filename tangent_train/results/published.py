"""Published scores, beside results of the same protocol.

``published.csv`` contains published scores in percent with their sources, one score per line, and
those of single classes of Stanford2D3DS. ``protocols.yaml`` contains the facts that make scores
comparable (`LabeledData.facts`, `Task.facts`), for each ``protocol`` of the scores. A score
stands beside a result if all facts are the same; else the facts that differ are named.

Of the paper (Eder, Shvets, Lim and Frahm, CVPR 2020, arXiv:1912.09390), the file contains the
tables of semantic segmentation, shape classification and network transfer, and the per-class
tables of the supplement. Lines with a ``stage`` belong to the transfer: they are the single folds,
because the paper's rows for all folds repeat fold 3; scores per class are over all folds.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from statistics import fmean
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped]

from tangent_train.results.record import Record
from tangent_train.results.rows import Row
from tangent_train.results.tables import Table, score_text

_KEY = ("protocol", "stage", "method", "trained_on", "level", "base_level", "inputs", "source")
_NOT_FACTS = ("about", "experiment")
_MOST_NAMED = 3


class Publication(NamedTuple):
    """The lines of a method in ``published.csv``.

    Attributes:
        key: Columns that all lines share.
        lines: Lines of scores and folds.
    """

    key: Mapping[str, str]
    lines: Sequence[Mapping[str, str]]

    @property
    def name(self) -> str:
        """Name of the method, with the stage of the transfer and the training data."""
        stage, method = self.key["stage"], self.key["method"]
        named = [stage] if stage and method == "tangent images" else [method, stage]
        trained = self.key["trained_on"]
        return ", ".join(filter(None, [*named, trained and f"trained on {trained}"]))

    @property
    def scores(self) -> list[float]:
        """Scores of the folds in percent, without mAcc."""
        named = [line for line in self.lines if line["score"] != "macc"]
        return [float(line["mean"]) for line in named if line["mean"]]

    @property
    def folds(self) -> tuple[str, ...]:
        """Folds with a score; empty for means over all folds."""
        return tuple(dict.fromkeys(line["fold"] for line in self.lines if line["fold"]))

    def differences(self, record: Record) -> dict[str, tuple[str, str]]:
        """Return the facts, published and of an evaluation, that differ."""
        published, found = facts(self.key["protocol"]), dict(record.protocol)
        if self.key["level"]:
            published["level"] = self.key["level"]
            found["level"] = str(record.settings.get("level"))
        if self.folds and record.fold is not None and str(record.fold) not in self.folds:
            published["fold"], found["fold"] = ", ".join(self.folds), str(record.fold)
        pairs = {n: (published.get(n, "–"), found.get(n, "–")) for n in {**published, **found}}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

    def row(self, like: Record, shown: Sequence[str] = ()) -> Row:
        """Return a row with the headings and classes of an evaluation.

        Args:
            like: Evaluation.
            shown: Facts of the protocol that are columns of the tables.
        """
        folds: dict[str, list[Mapping[str, str]]] = defaultdict(list)
        for line in self.lines:
            folds[line["fold"]].append(line)
        records = tuple(_record(like, fold, lines) for fold, lines in folds.items())
        protocol = facts(self.key["protocol"])
        columns = {
            "data": protocol["data"],
            "s": self.key["level"] or "–",
            "input": self.key["inputs"] or "–",
            "b": self.key["base_level"] or "–",
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
        records: Sequence[Record], *, transfer: bool = False, shown: Sequence[str] = ()
    ) -> Comparison:
        """Compare evaluations with the published scores on their data sets.

        Args:
            records: Evaluations with the same scores.
            transfer: True for scores of networks that were trained on other data.
            shown: Facts of the protocols that are columns of the tables.
        """
        found: list[Publication] = []
        others: dict[tuple[str, str], list[Publication]] = defaultdict(list)
        nearest: dict[tuple[str, str], dict[str, tuple[str, str]]] = {}
        for publication in publications():
            key = publication.key
            on_data = [
                r for r in records if r.protocol.get("data") == facts(key["protocol"])["data"]
            ]
            has_score = any(line["score"] in records[0].headings for line in publication.lines)
            fits = key["stage"] or key["trained_on"] if transfer else not key["stage"]
            if not (on_data and has_score and fits):
                continue
            differences = min((publication.differences(r) for r in on_data), key=len)
            if differences:
                group = key["protocol"], ", ".join(differences)
                others[group].append(publication)
                nearest[group] = differences
            else:
                found.append(publication)
        rows = [publication.row(records[0], shown) for publication in found]
        sources = ", ".join(dict.fromkeys(p.key["source"] for p in found))
        notes = [f"Published scores of the same protocol: {sources}."] if found else []
        some = sorted(others, key=lambda group: len(nearest[group]))[:_MOST_NAMED]
        return Comparison(
            rows, [*notes, *(_difference(others[group], nearest[group]) for group in some)]
        )

    def tables(self, like: Record) -> list[Table]:
        """Return a table of the rows for one evaluation, or nothing without rows.

        Args:
            like: Evaluation with the headings and the fold.
        """
        fold, rows = like.fold, self.rows
        rows = [row.of_fold(fold) if fold and fold in row.folds else row for row in rows]
        if not rows:
            return []
        names = [n for n in like.headings if any(r.score(n).mean is not None for r in rows)]
        cells = [
            (
                row.label,
                row.facts["input"],
                *(score_text(row.score(name).mean, like.headings[name].unit) for name in names),
            )
            for row in rows
        ]
        header = ("", "input", *(like.headings[name].column for name in names))
        return [Table("Published, same protocol", header, cells, text_columns=(0, 1))]


def _difference(
    publications: Sequence[Publication], differences: Mapping[str, tuple[str, str]]
) -> str:
    """Return a sentence on published scores of another protocol."""
    best = max(publications, key=lambda publication: fmean(publication.scores or [0.0]))
    text = ", ".join(f"{score:g}" for score in best.scores)
    more = f" and {len(publications) - 1} more" if len(publications) > 1 else ""
    named = "; ".join(f"{n}: published {p}, this run {r}" for n, (p, r) in differences.items())
    return f"Not comparable: {best.name}: {text}{more} ({best.key['protocol']}). {named}."


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
        groups[tuple(line[name] for name in _KEY)].append(line)
    return tuple(
        Publication(dict(zip(_KEY, key, strict=True)), lines) for key, lines in groups.items()
    )


def published_lines() -> Iterator[dict[str, str]]:
    """Yield the lines of ``published.csv``."""
    yield from csv.DictReader(_read("published.csv").splitlines())


def _read(name: str) -> str:
    return files("tangent_train.results").joinpath(name).read_text(encoding="utf-8")


def _record(like: Record, fold: str, lines: Sequence[Mapping[str, str]]) -> Record:
    by_score = {line["score"]: line for line in lines}
    means = {name: _share(by_score.get(name, {}).get("mean")) for name in like.means}
    pairs = like.class_means.items()
    classes = [
        {"class": c, **{name: _share(by_score.get(mean, {}).get(c)) for name, mean in pairs}}
        for c in like.class_names
    ]
    settings = {"data.fold": int(fold) if fold else None}
    return Record("", 0, like.headings, means, classes, settings=settings)


def _share(percent: str | None) -> float | None:
    return round(float(percent) / 100, 6) if percent else None
