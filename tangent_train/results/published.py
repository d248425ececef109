"""Published scores, beside results of the same protocol.

``published.csv`` contains published scores with their sources, one score per line, and those of
single classes of Stanford2D3DS: in percent, or in the unit of the score, see `ScoreColumn`.
``protocols.yaml`` contains the facts that make scores
comparable (`DataModule.facts`, `Head.facts`), for each ``protocol`` of the scores. A score
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
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from statistics import fmean
from typing import Any

import yaml  # type: ignore[import-untyped]

from tangent_train.results.evaluation import EvaluationResult
from tangent_train.results.rows import Part, RunRow, Value
from tangent_train.results.tables import Table, score_text

_KEYS = ["protocol", "stage", "method", "trained_on", "level", "base_level", "inputs", "source"]
"""Columns of ``published.csv`` that are equal in all lines of a method."""

_MOST_NAMED = 3

Lines = Sequence[Mapping[str, str]]
"""Lines of ``published.csv`` of one method."""


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
    methods: dict[tuple[str, ...], list[Mapping[str, str]]] = defaultdict(list)
    for line in published_lines():
        methods[tuple(line[name] for name in _KEYS)].append(line)
    groups: dict[tuple[str, ...], list[Lines]] = defaultdict(list)
    for lines in methods.values():
        first, names = lines[0], {line["score"] for line in lines}
        on_data = [
            r for r in results if r.protocol.get("data") == first["data"] and names & {*r.scores}
        ]
        is_wanted = first["stage"] or first["trained_on"] if transfer else not first["stage"]
        if on_data and is_wanted:
            groups[min((_differences(lines, r) for r in on_data), key=len)].append(lines)
    same = groups.pop((), [])
    sources = ", ".join(dict.fromkeys(lines[0]["source"] for lines in same))
    notes = [f"Published scores of the same protocol: {sources}."] if same else []
    nearest = sorted(groups, key=len)[:_MOST_NAMED]
    notes += [_note(groups[some], some, results[0]) for some in nearest]
    return [_row(lines, results[0], shown) for lines in same], notes


def published_table(rows: Sequence[RunRow], like: EvaluationResult) -> Table:
    """Return a table of published scores for one evaluation.

    Args:
        rows: Rows of published scores.
        like: Evaluation with the scores and the fold.
    """
    means = [
        {
            n: row.score(n, fold=like.fold if like.fold in row.folds else None).mean
            for n in like.columns
        }
        for row in rows
    ]
    shown = {n: c for n, c in like.columns.items() if any(mean[n] is not None for mean in means)}
    cells = [
        (row.label, row.facts["input"], *(score_text(mean[n], c.unit) for n, c in shown.items()))
        for row, mean in zip(rows, means, strict=True)
    ]
    header = ("", "input", *(column.title for column in shown.values()))
    return Table("Published, same protocol", header, cells, text_columns=(0, 1))


def _name(line: Mapping[str, str]) -> str:
    """Return the name of a method, with the stage of the transfer and the training data."""
    method = "" if line["stage"] and line["method"] == "tangent images" else line["method"]
    trained = line["trained_on"] and f"trained on {line['trained_on']}"
    return ", ".join(filter(None, (method, line["stage"], trained)))


def _folds(lines: Lines) -> str:
    """Return the folds with a score; "" for means over all folds."""
    return ", ".join(dict.fromkeys(line["fold"] for line in lines if line["fold"]))


def _differences(lines: Lines, result: EvaluationResult) -> tuple[str, ...]:
    """Return the facts that differ from those of an evaluation, with both values."""
    published, found = facts(lines[0]["protocol"]), dict(result.protocol)
    found.pop("views_aligned", None)  # of the method
    if level := lines[0]["level"]:
        published["level"], found["level"] = level, str(result.settings.get("level"))
    folds = _folds(lines)
    if folds and result.fold is not None and str(result.fold) not in folds.split(", "):
        published["fold"], found["fold"] = folds, str(result.fold)
    pairs = {n: (published.get(n, "–"), found.get(n, "–")) for n in {**published, **found}}
    return tuple(f"{n}: published {p}, this run {r}" for n, (p, r) in pairs.items() if p != r)


def _row(lines: Lines, like: EvaluationResult, shown: Sequence[str]) -> RunRow:
    """Return a row with the scores and classes of an evaluation."""
    of_class = {mean: name for name, mean in like.class_means.items()}
    scores: dict[tuple[str, Part], list[Value]] = defaultdict(list)
    for line in lines:
        fold, mean = int(line["fold"]) if line["fold"] else None, line["score"]
        texts: dict[tuple[str, Part], str | None] = {}
        if mean in like.columns:
            texts[mean, None] = line["mean"]
        if mean in of_class:
            texts |= {(of_class[mean], name): line.get(name) for name in like.class_names}
        for key, text in texts.items():
            if text:
                whole = 100 if like.columns[mean].unit == "%" else 1
                scores[key].append((fold, None, round(float(text) / whole, 6)))
    first, protocol = lines[0], facts(lines[0]["protocol"])
    columns = {
        "data": protocol["data"],
        "s": first["level"] or "–",
        "input": first["inputs"] or "–",
        "b": first["base_level"] or "–",
        "folds": _folds(lines) or "–",
        **{name: protocol.get(name, "–") for name in shown},
    }
    return RunRow(f"{_name(first)} (paper)", scores, columns)


def _note(group: Sequence[Lines], differences: Sequence[str], result: EvaluationResult) -> str:
    """Return a sentence on published scores with the same differences from an evaluation."""
    sign = -1 if result.columns[result.main].better == "lower" else 1
    named = [
        ([float(x["mean"]) for x in lines if x["score"] == result.main and x["mean"]], lines[0])
        for lines in group
    ]
    scores, best = max(named, key=lambda pair: fmean([sign * s for s in pair[0]] or [-math.inf]))
    text = f"{_name(best)}: {', '.join(f'{score:g}' for score in scores)}"
    more = f" and {len(group) - 1} more" if len(group) > 1 else ""
    return f"Not comparable: {text}{more} ({best['protocol']}). {'; '.join(differences)}."


@cache
def protocols() -> Mapping[str, Mapping[str, Any]]:
    """Return the protocols by name: their facts, ``about`` and, if there is one, ``experiment``."""
    content: dict[str, Any] = yaml.safe_load(_read("protocols.yaml"))
    return {name: entry for name, entry in content.items() if not name.startswith("_")}


def facts(protocol: str) -> dict[str, str]:
    """Return the facts of a protocol by name."""
    entry = protocols()[protocol].items()
    return {name: str(value) for name, value in entry if name not in ("about", "experiment")}


@cache
def published_lines() -> Sequence[Mapping[str, str]]:
    """Return the lines of ``published.csv``."""
    return list(csv.DictReader(_read("published.csv").splitlines()))


def _read(name: str) -> str:
    return files("tangent_train.results").joinpath(name).read_text(encoding="utf-8")
