"""Reports over groups of runs, the stages of a transfer, and one network at several levels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.published import Comparison
from tangent_train.results.report import Cell, Report
from tangent_train.results.rows import Row, check_alike, group_runs

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


def runs_report(records: Sequence[EvaluationResult], notes: Sequence[str] = ()) -> Report:
    """Report the mean and spread of each group of finished runs, with published scores.

    Args:
        records: Records of the runs.
        notes: Notes to add.
    """
    shown = _differing_facts(records)
    rows = [replace(row, facts=_facts(row.records, shown)) for row in group_runs(records)]
    published = Comparison.of(records, shown=shown)
    merged = sorted(
        [*published.rows, *rows], key=lambda row: (row.facts["data"], row.facts["s"].zfill(2))
    )
    return Report("Report", merged, [*_repeated(rows), *notes, *published.notes])


def _differing_facts(records: Sequence[EvaluationResult]) -> list[str]:
    """Return the facts of the protocols in which evaluations differ, besides the data."""
    names = dict.fromkeys(name for record in records for name in record.protocol)
    return [
        name
        for name in names
        if name not in ("data", "classes", "test_rotation")
        and len({record.protocol.get(name) for record in records}) > 1
    ]


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
    stages: Mapping[str, Sequence[EvaluationResult]], cells: Mapping[str, Cell] | None = None
) -> Report:
    """Report a transfer from photos to panoramas, with published scores.

    Args:
        stages: Evaluations by the names of their stages. S, S-erp and S-FT-10, tested on panoramas,
            are compared with P and P-FT-10, tested on photos, after the same fine-tuning.
        cells: View and condition of stages that evaluate the same network.
    """
    check_alike([record for records in stages.values() for record in records])
    rows = [Row(name, tuple(records), _facts(records)) for name, records in stages.items()]
    published = Comparison.of([r for records in stages.values() for r in records], transfer=True)
    rows += published.rows
    by_name = {row.label: row for row in rows}
    rows = [replace(row, partner=by_name.get(_photos_of(row.label))) for row in rows]
    compared = _CHANGE_OF_STAGES if any(row.partner for row in rows) else ""
    title = "Transfer from photos to panoramas"
    return Report(title, rows, published.notes, compared, cells or {})


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


def levels_report(levels: Mapping[int, Sequence[EvaluationResult]], trained_level: float) -> Report:
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


def _facts(records: Sequence[EvaluationResult], shown: Sequence[str] = ()) -> dict[str, str]:
    record = records[0]
    facts = {
        "data": record.data,
        "s": str(record.settings.get("level") or "–"),
        "input": _inputs(record),
        "b": _base_level(record),
        **{name: record.protocol.get(name, "–") for name in shown},
    }
    if "data.test_rotation" in record.settings and "data.inputs" not in record.settings:  # shapes
        names = ("representation.random_rotation", "data.test_rotation")
        rotations = map(record.settings.get, names)
        facts["rotated in training / test"] = " / ".join(
            _ROTATIONS.get(r, str(r)) for r in rotations
        )
    if record.label_map is not None:
        facts["label map"] = record.label_map
    folds = [str(fold) for fold in dict.fromkeys(r.fold for r in records) if fold is not None]
    return facts | {"folds": ", ".join(folds) or "–", "runs": str(len(records))}


def _inputs(record: EvaluationResult) -> str:
    """Return RGB or RGB-D, as in the paper, and further inputs; a dash for shapes."""
    names = record.settings.get("data.inputs")
    if names is None:
        return "–"
    further = [name for name in names if name not in ("rgb", "depth")]
    return " + ".join(["RGB-D" if "depth" in names else "RGB", *further])


def _base_level(record: EvaluationResult) -> str:
    """Return the base level b of tangent images, or a short name of another representation."""
    base = record.settings.get("representation.base_level")
    if base is not None:
        return str(base)
    target = str(record.settings.get("representation._target_")).rpartition(".")[2]
    name = target.removesuffix("Representation")
    aware = ", distortion-aware" * bool(record.settings.get("representation.distortion_aware"))
    return _REPRESENTATIONS.get(name, name) + aware
