"""Published figures, from ``paper.csv``.

Eder, Shvets, Lim and Frahm: Tangent Images for Mitigating Spherical Distortion, CVPR 2020
(arXiv:1912.09390), and the work it compares with: the tables of semantic segmentation, shape
classification and network transfer, and the per-class tables of the supplement. Percent.

Rows without a stage are of networks trained on panoramas, "averaged over the 3 folds" on
Stanford2D3DS. For the transfer the file has the single folds, because the rows for all folds
repeat fold 3; its scores per class are over all folds.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from tangent_train.results.record import Record
from tangent_train.results.rows import Row

__all__ = ["published"]

_MEANS = {
    "segmentation": {"accuracy": "macc", "iou": "miou"},
    "classification": {"accuracy": "accuracy"},
}
_KEY = ("data", "stage", "method", "level", "base_level", "inputs")


def published(records: Sequence[Record], *, transfer: bool = False) -> list[Row]:
    """Published scores for the data and resolutions of some evaluations.

    Args:
        records: Evaluations; those on other data, other classes or rotated data match nothing.
        transfer: Whether to take the figures of the network transfer.

    Returns:
        Rows in the order of the file.
    """
    own = {(r.data, str(len(r.classes)), str(r.settings.get("level"))) for r in records}
    lines: dict[tuple[str, ...], list[dict[str, str]]] = defaultdict(list)
    text = files("tangent_train.results").joinpath("paper.csv").read_text(encoding="utf-8")
    for line in csv.DictReader(text.splitlines()):
        known = (line["data"], line["classes"], line["level"]) in own
        if known and bool(line["stage"]) is transfer:
            lines[tuple(line[name] for name in _KEY)].append(line)
    return [_row(records[0], dict(zip(_KEY, k, strict=True)), found) for k, found in lines.items()]


def _row(like: Record, key: dict[str, str], lines: list[dict[str, str]]) -> Row:
    of_fold: dict[str, list[dict[str, str]]] = defaultdict(list)
    for line in lines:
        of_fold[line["fold"]].append(line)
    records = tuple(_record(like, fold, found) for fold, found in of_fold.items())
    tangent = key["method"] == "tangent images"
    name = key["stage"] if tangent and key["stage"] else key["method"]
    if key["stage"] and not tangent:
        name += f", {key['stage']}"
    facts = {
        "data": key["data"],
        "s": key["level"],
        "input": key["inputs"] or "–",
        "b": key["base_level"] or "–",
    }
    return Row(f"{name} (paper)", records, facts, published=True)


def _record(like: Record, fold: str, lines: Sequence[dict[str, str]]) -> Record:
    means: dict[str, float | None] = {}
    classes: dict[str, dict[str, Any]] = {name: {"class": name} for name in like.class_names}
    for line in lines:
        means[_MEANS[like.kind][line["score"]]] = _share(line["mean"])
        for name, entry in classes.items():
            entry[line["score"]] = _share(line.get(name, ""))
    settings = {"data.fold": int(fold) if fold else None}
    return Record(like.kind, "", 0, means, list(classes.values()), settings=settings)


def _share(percent: str) -> float | None:
    return round(float(percent) / 100, 6) if percent else None
