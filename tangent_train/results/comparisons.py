"""Reports over groups of runs, the stages of a transfer, and one network at several levels.

``paper.csv`` contains published scores in percent: Eder, Shvets, Lim and Frahm, Tangent Images for
Mitigating Spherical Distortion, CVPR 2020 (arXiv:1912.09390), and the work that it compares with.
They are the tables of semantic segmentation, shape classification and network transfer, and the
per-class tables of the supplement. Rows without a stage are for networks trained on panoramas,
"averaged over the 3 folds" on Stanford2D3DS. For the transfer, the file has the single folds,
because the paper's rows for all folds repeat fold 3; its scores per class are over all folds.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files

from tangent_train.results.record import Record
from tangent_train.results.report import Cell, Report
from tangent_train.results.rows import Row, check_alike, group_runs

_KEY = ("data", "stage", "method", "level", "base_level", "inputs")

_REPRESENTATIONS = {
    "Cubemap": "cube map",
    "Equirect": "ERP",
    "Perspective": "photos",
    "Tangent": "tangent images",
}
_CHANGE_OF_STAGES = (
    "Change: from photos after the same fine-tuning, over the folds and seeds that both have."
)
_ROTATIONS = {None: "–", "none": "–", "yaw": "z", "so3": "SO3"}
"""Usual names of no rotation, rotation about the vertical axis, and arbitrary rotation."""


def runs_report(records: Sequence[Record], notes: Sequence[str] = ()) -> Report:
    """Report the mean and spread of each group of finished runs, with the paper's figures.

    Args:
        records: Records of the runs.
        notes: Notes to add.
    """
    rows = [replace(row, facts=_facts(row.records)) for row in group_runs(records)]
    merged = sorted(
        [*published(records), *rows], key=lambda row: (row.facts["data"], row.facts["s"].zfill(2))
    )
    return Report("Report", merged, [*_repeated(rows), *notes])


def _repeated(rows: Sequence[Row]) -> Iterator[str]:
    """Yield notes on runs with the same fold and seed."""
    for row in rows:
        seen: set[tuple[int | None, int | None]] = set()
        for record in row.records:
            if (record.fold, record.seed) in seen:
                where = "" if record.fold is None else f"fold {record.fold}, "
                twice = f"{where}seed {record.seed} more than once, also in {record.folder}."
                yield f"{row.label}: {twice}"
            seen.add((record.fold, record.seed))


def transfer_report(
    stages: Mapping[str, Sequence[Record]], cells: Mapping[str, Cell] | None = None
) -> Report:
    """Report a transfer from photos to panoramas, with the paper's figures.

    Args:
        stages: Evaluations by the names of their stages. S, S-erp and S-FT-10, tested on panoramas,
            are compared with P and P-FT-10, tested on photos, after the same fine-tuning.
        cells: View and condition of stages that evaluate the same network.
    """
    check_alike([record for records in stages.values() for record in records])
    rows = [Row(name, tuple(records), _facts(records)) for name, records in stages.items()]
    panoramas = [r for name, records in stages.items() if name[0] == "S" for r in records]
    rows += published(panoramas, transfer=True)
    by_name = {row.label: row for row in rows}
    rows = [replace(row, partner=by_name.get(_photos_of(row.label))) for row in rows]
    compared = _CHANGE_OF_STAGES if any(row.partner for row in rows) else ""
    return Report("Transfer from photos to panoramas", rows, (), compared, cells or {})


def _photos_of(stage: str) -> str:
    """Return the stage on photos with the same fine-tuning; "" for a stage on photos.

    >>> _photos_of("S-FT-10 (paper)"), _photos_of("S-erp"), _photos_of("P")
    ('P-FT-10 (paper)', 'P', '')
    """
    name, mark, paper = stage.partition(" (paper)")
    if name[0] != "S":
        return ""
    photos = f"P{name[1:]}" if "-FT-" in name else "P"
    return photos + mark + paper


def levels_report(levels: Mapping[int, Sequence[Record]], trained_level: float) -> Report:
    """Report one network at several levels of the panoramas.

    This is the paper's third transfer experiment: photos are normalized to the angular resolution
    of one level; scores decrease with the difference from the resolution of the panoramas.

    Args:
        levels: Evaluations by level.
        trained_level: Level with the angular resolution of the photos in training; a fraction if it
            is between two levels.
    """
    check_alike([record for records in levels.values() for record in records])
    rows = {
        level: Row(f"level {level}", tuple(levels[level]), _facts(levels[level]))
        for level in sorted(levels)
    }
    nearest = min(rows, key=lambda level: abs(level - trained_level))
    compared = [
        row if level == nearest else replace(row, partner=rows[nearest])
        for level, row in rows.items()
    ]
    note = f"Photos in training: the angular resolution of level {trained_level:g}."
    change = f"Change: from level {nearest}, over the folds and seeds that both have."
    return Report("One network at several levels", compared, [note], change)


def _facts(records: Sequence[Record]) -> dict[str, str]:
    record = records[0]
    facts = {
        "data": record.data,
        "s": str(record.settings.get("level") or "–"),
        "input": _inputs(record),
        "b": _base_level(record),
    }
    if "data.test_rotation" in record.settings and "data.inputs" not in record.settings:  # shapes
        names = ("representation.random_rotation", "data.test_rotation")
        rotations = map(record.settings.get, names)
        facts["rotated in training / test"] = " / ".join(
            _ROTATIONS.get(r, str(r)) for r in rotations
        )
    if record.class_map is not None:
        facts["class map"] = record.class_map
    folds = [str(fold) for fold in dict.fromkeys(r.fold for r in records) if fold is not None]
    return facts | {"folds": ", ".join(folds) or "–", "runs": str(len(records))}


def _inputs(record: Record) -> str:
    """Return RGB or RGB-D, as in the paper, and further inputs; a dash for shapes."""
    names = record.settings.get("data.inputs")
    if names is None:
        return "–"
    further = [name for name in names if name not in ("rgb", "depth")]
    return " + ".join(["RGB-D" if "depth" in names else "RGB", *further])


def _base_level(record: Record) -> str:
    """Return the base level b of tangent images, or a short name of another representation."""
    base = record.settings.get("representation.base_level")
    if base is not None:
        return str(base)
    target = str(record.settings.get("representation._target_")).rpartition(".")[2]
    name = target.removesuffix("Representation")
    return _REPRESENTATIONS.get(name, name)


def published(records: Sequence[Record], *, transfer: bool = False) -> list[Row]:
    """Return published scores for the data and levels of evaluations.

    Args:
        records: Evaluations. For other data sets, classes and rotated data, nothing is published.
        transfer: True for the scores of the network transfer.

    Returns:
        Rows in the order of the file.
    """
    wanted = {(r.data, str(len(r.classes)), str(r.settings.get("level"))) for r in records}
    lines: dict[tuple[str, ...], list[dict[str, str]]] = defaultdict(list)
    text = files("tangent_train.results").joinpath("paper.csv").read_text(encoding="utf-8")
    for line in csv.DictReader(text.splitlines()):
        is_wanted = (line["data"], line["classes"], line["level"]) in wanted
        is_wanted = is_wanted and line["score"] in records[0].headings
        if is_wanted and bool(line["stage"]) is transfer:
            lines[tuple(line[name] for name in _KEY)].append(line)
    return [_row(records[0], dict(zip(_KEY, k, strict=True)), group) for k, group in lines.items()]


def _row(like: Record, key: dict[str, str], lines: list[dict[str, str]]) -> Row:
    """Return a row of published scores with the headings and classes of an evaluation."""
    folds: dict[str, list[dict[str, str]]] = defaultdict(list)
    for line in lines:
        folds[line["fold"]].append(line)
    records = tuple(_record(like, fold, group) for fold, group in folds.items())
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
