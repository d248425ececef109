"""Several runs as one result: mean and spread over folds and seeds.

Runs that differ only in fold and seed (and in where and how they were computed) form a group. A
figure of a group is first averaged over the seeds of each fold, then over the folds, as the paper's
"averaged over the 3 folds". Two spreads, sample standard deviations, tell two things: over the
folds' means, how different the folds are; over seeds, pooled over the folds that have several, how
far training itself is repeatable.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from datamodules.stanford2d3ds.files import FOLDS
from tangent_train.errors import DataError
from tangent_train.results.reports.paper import CLASSES, PaperRow, paper_row
from tangent_train.results.reports.runs import RESULTS_FILE, Run
from tangent_train.setting_rules import may_differ

__all__ = ["REAL", "Figure", "Group", "average", "check_classes", "group_runs"]

REAL = "datamodules.Stanford2D3DS"
"""The real data set of the paper's segmentation."""

# Rooms are made in the areas of the real ones.
_FOLDED = tuple(
    f"datamodules.{name}{of_photos}"
    for name in ("Stanford2D3DS", "SynthRooms")
    for of_photos in ("", "Perspective")
)
_NO_BASE_LEVEL = {"CubemapRepresentation": "cubemap", "PerspectiveRepresentation": "photos"}


@dataclass(frozen=True)
class Figure:
    """A figure of a group, as shares of 1.

    Attributes:
        mean: Over the folds' means; None where it is defined in no run.
        over_folds: Standard deviation of the folds' means; None with one fold.
        over_seeds: Pooled standard deviation within folds; None with one seed for each.
        folds: How many folds have the figure: a class may be absent from a fold.
    """

    mean: float | None
    over_folds: float | None
    over_seeds: float | None
    folds: int


@dataclass(frozen=True)
class Group:
    """Runs that differ only in fold and seed.

    Attributes:
        label: Their name, with the settings in which it differs from others of that name.
        runs: Sorted by fold and seed.
    """

    label: str
    runs: tuple[Run, ...]

    @property
    def kind(self) -> str:
        """What was learned, a key of `runs.FIGURES`."""
        return self.runs[0].kind

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes of its results."""
        return self.runs[0].class_names

    @property
    def folds(self) -> tuple[int, ...]:
        """The folds it has."""
        return tuple(sorted({run.fold for run in self.runs if run.fold is not None}))

    @property
    def missing_folds(self) -> tuple[int, ...]:
        """The folds it lacks for a mean of all of them; empty where the folds are not known."""
        if self.setting("data._target_") not in _FOLDED:
            return ()
        return tuple(fold for fold in FOLDS if fold not in self.folds)

    @property
    def repeated(self) -> tuple[Run, ...]:
        """Runs whose fold and seed another one has as well."""
        seen: set[Any] = set()
        extra = []
        for run in self.runs:
            key = (run.fold, run.settings.get("seed"))
            extra += [run] if key in seen else []
            seen.add(key)
        return tuple(extra)

    @property
    def data(self) -> str:
        """Its data set, and whether the test panoramas were turned (of shapes tables say that)."""
        name = str(self.setting("data._target_")).rpartition(".")[2]
        turned = self.setting("data.test_rotation")
        if turned is None or self.kind == "classification":
            return name
        return f"{name}, test panoramas turned: {turned}"

    @property
    def inputs(self) -> str:
        """RGB or RGB-D, as the paper writes it."""
        names = self.setting("data.inputs") or ()
        further = [name for name in names if name not in ("rgb", "depth")]
        return " + ".join(["RGB-D" if "depth" in names else "RGB", *further])

    @property
    def base_level(self) -> int | str:
        """The base level b; ERP for equirectangular images, and what else has none."""
        base_level = self.setting("representation.base_level")
        if base_level is not None:
            return int(base_level)
        target = str(self.setting("representation._target_")).rpartition(".")[2]
        return _NO_BASE_LEVEL.get(target, "ERP")

    @property
    def paper(self) -> PaperRow | None:
        """The paper's row for the same data, resolution, base level and inputs.

        None for made rooms, whose figures say nothing about real ones, and for turned panoramas.
        """
        same_data = (
            self.setting("data._target_") == REAL
            and self.setting("data.test_rotation") is None
            and self.class_names == CLASSES
        )
        if not same_data or isinstance(self.base_level, str):
            return None
        return paper_row(self.setting("level"), self.base_level, self.inputs)

    def setting(self, name: str) -> Any:
        """A setting, the same in all runs; None where there is none."""
        return self.runs[0].settings.get(name)

    def figure(self, name: str, class_index: int | None = None) -> Figure:
        """Mean and spread of a figure.

        Args:
            name: One of the means of its kind, see `runs.FIGURES`, or with a class of the figures
                per class.
            class_index: Which class.
        """
        values = [(run.fold, run.figure(name, class_index)) for run in self.runs]
        return average([(fold, value) for fold, value in values if value is not None])


def average(values: Iterable[tuple[int | None, float]]) -> Figure:
    """Mean over folds of the mean over seeds, with both spreads.

    Args:
        values: Fold and figure of each run that has the figure.

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
    return Figure(
        mean=fmean(means) if means else None,
        over_folds=stdev(means) if len(means) > 1 else None,
        over_seeds=(squares / freedom) ** 0.5 if freedom else None,
        folds=len(means),
    )


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Put runs together that differ only in fold and seed.

    Args:
        runs: From `load_run`.

    Returns:
        Groups in the order of their first runs.

    Raises:
        DataError: Runs have different classes.
    """
    check_classes(runs)
    members: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        members[json.dumps(_identity(run), sort_keys=True, default=str)].append(run)
    labels = _labels([found[0] for found in members.values()])
    return [
        Group(label, tuple(sorted(found, key=_order)))
        for label, found in zip(labels, members.values(), strict=True)
    ]


def check_classes(runs: Sequence[Run]) -> None:
    """Check that runs are of one kind and have the same classes.

    Raises:
        DataError: They have not.
    """
    for run in runs:
        if run.kind != runs[0].kind:
            raise DataError(
                run.folder / RESULTS_FILE,
                found=f"results of {run.kind}",
                expected=f"{runs[0].kind}, as in {runs[0].folder / RESULTS_FILE}",
                remedy="Report them apart.",
            )
        if run.class_names != runs[0].class_names:
            raise DataError(
                run.folder / RESULTS_FILE,
                found=f"classes {', '.join(run.class_names)}",
                expected=f"{', '.join(runs[0].class_names)}, as in {runs[0].folder / RESULTS_FILE}",
                remedy="Report runs with different classes apart.",
            )


def _identity(run: Run) -> dict[str, Any]:
    return {
        # Each fold is fine-tuned from a checkpoint of its own.
        name: value is not None if name == "init_from" else value
        for name, value in run.settings.items()
        if not may_differ(name, "report")
    }


def _order(run: Run) -> tuple[int, int, str]:
    return run.fold or 0, int(run.settings.get("seed") or 0), str(run.folder)


def _labels(firsts: Sequence[Run]) -> list[str]:
    """The runs' names, with what tells groups of the same name apart."""
    labels: list[str] = []
    used: Counter[str] = Counter()
    for run in firsts:
        own = _identity(run)
        others = [other for other in map(_identity, firsts) if other.get("name") == own.get("name")]
        differing = [
            setting
            for setting in sorted({key for other in others for key in other})
            if any(other.get(setting) != own.get(setting) for other in others)
        ]
        text = ", ".join(f"{setting}={_short(own.get(setting))}" for setting in differing[:3])
        more = ", …" if len(differing) > 3 else ""
        label = str(own.get("name") or run.folder.name) + (f" ({text}{more})" if text else "")
        used[label] += 1
        labels.append(f"{label} #{used[label]}" if used[label] > 1 else label)
    return labels


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
