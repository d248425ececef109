"""Transfer from photos to panoramas: stages over folds and seeds, and what of a figure is kept.

The paper's section "Network transfer": a network trained on photos (P) is run on panoramas through
tangent images (S), as it is and after fine-tuning on either kind (FT-1, FT-10). A figure is
averaged over seeds and folds as in `reports.groups`; what is kept of it is S over P with the same
fine-tuning.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from tangent_train.errors import DataError
from tangent_train.results.reports.groups import Group, check_classes
from tangent_train.results.reports.runs import Run
from tangent_train.results.transfer.rows import Averages, check_once, sort_key

__all__ = ["Row", "StageResult", "TransferReport", "gather"]


@dataclass(frozen=True)
class StageResult:
    """One run of a stage.

    Attributes:
        stage: Its name, as "P", "S-FT-10" or "S-erp".
        on: What the network was tested on.
        epochs: Of fine-tuning; 0 without.
        representation: How the network saw it: "perspective", "tangent", "erp", "cubemap".
        fold: The fold it was tested on; None for data without folds.
        seed: Of the training on photos that all stages go back to.
        run: Its figures and settings.
    """

    stage: str
    on: Literal["photos", "panoramas"]
    epochs: int
    representation: str
    fold: int | None
    seed: int
    run: Run


@dataclass(frozen=True)
class Row(Averages[StageResult]):
    """A stage over folds and seeds; its partner is the photos' row with as much fine-tuning."""

    @property
    def kind(self) -> StageResult:
        """Any of its runs, for what all have in common but fold, seed and run."""
        return self.results[0]

    @property
    def name(self) -> str:
        """The stage's name."""
        return self.kind.stage


@dataclass(frozen=True)
class TransferReport:
    """All stages.

    Attributes:
        rows: By fine-tuning, photos before panoramas, tangent images before the other ways.
        class_names: The classes of all results.
    """

    rows: tuple[Row, ...]
    class_names: tuple[str, ...]

    @property
    def folds(self) -> tuple[int | None, ...]:
        """The folds of all rows."""
        found = {fold for row in self.rows for fold in row.folds}
        return tuple(sorted(found, key=lambda fold: fold or 0))

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of all rows."""
        return tuple(sorted({result.seed for row in self.rows for result in row.results}))

    @property
    def panoramas(self) -> tuple[Row, ...]:
        """The rows tested on panoramas."""
        return tuple(row for row in self.rows if row.kind.on == "panoramas")

    @property
    def group(self) -> Group | None:
        """Its first runs on panoramas, for their data, level and inputs; None without any."""
        for row in self.panoramas:
            return Group(row.name, tuple(result.run for result in row.results))
        return None

    def of_fold(self, fold: int | None) -> TransferReport:
        """What was run on a fold."""
        rows = [row.of_fold(fold) for row in self.rows]
        return replace(self, rows=tuple(row for row in rows if row is not None))


def gather(results: Sequence[StageResult]) -> TransferReport:
    """Put the runs of stages together.

    Args:
        results: In any order; a stage's name stands for one kind of data, fine-tuning and
            representation.

    Raises:
        DataError: There are none, their classes differ, a stage's name stands for two things, or
            a fold and seed of a stage is there twice.
    """
    if not results:
        raise DataError("transfer", found="no stage", expected="the results of one or more")
    check_classes([result.run for result in results])
    members: dict[str, list[StageResult]] = defaultdict(list)
    for result in results:
        members[result.stage].append(result)
    for found in members.values():
        _check_stage(found)
    rows = [Row(tuple(sorted(found, key=sort_key))) for found in members.values()]
    photos = {row.kind.epochs: row for row in rows if row.kind.on == "photos"}
    paired = [
        replace(row, partner=photos.get(row.kind.epochs)) if row.kind.on == "panoramas" else row
        for row in rows
    ]
    return TransferReport(tuple(sorted(paired, key=_order)), results[0].run.class_names)


def _check_stage(results: Sequence[StageResult]) -> None:
    """Check that runs of one stage are alike, and of different folds and seeds."""
    first = results[0]
    for result in results:
        if _kind(result) != _kind(first):
            raise DataError(
                result.run.folder,
                found=f"stage {result.stage}: {_kind(result)}",
                expected=f"{_kind(first)}, as in {first.run.folder}",
                remedy="Give other stages other names.",
            )
    check_once(results, f"stage {first.stage}")


def _kind(result: StageResult) -> str:
    return f"{result.on}, {result.epochs} epochs of fine-tuning, {result.representation}"


def _order(row: Row) -> tuple[int, bool, bool]:
    return row.kind.epochs, row.kind.on != "photos", row.kind.representation != "tangent"
