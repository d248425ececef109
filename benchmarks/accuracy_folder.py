"""What ``python -m benchmarks accuracy`` keeps in its folder, so that nothing is done twice."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from benchmarks.accuracy_rows import EXPERIMENT, PLAIN
from tangent_train.errors import SettingError
from tangent_train.files import write_text

if TYPE_CHECKING:
    from benchmarks.accuracy_rows import Row, Variant

__all__ = ["AccuracyFolder", "Device", "Plan", "results_of"]

Device = Literal["cpu", "cuda"]

_EXPERIMENT_HEIGHT = 128
"""Rows of the rooms in the experiment's own folder."""


@dataclass(frozen=True)
class Plan:
    """What all rows of a table have in common.

    Attributes:
        seconds: Training time of every row.
        level: Level s.
        rooms_height: Rows of the rooms' panoramas.
        device: Where it is computed.
        settings: Further overrides for all rows.
    """

    seconds: float
    level: int
    rooms_height: int
    device: Device
    settings: tuple[str, ...] = ()

    def overrides(self) -> tuple[str, ...]:
        """The experiment and what the plan changes of it."""
        height = self.rooms_height
        own = height == _EXPERIMENT_HEIGHT
        rooms = () if own else (f"data.root=data/rooms_{height}", f"data.rooms.height={height}")
        return (EXPERIMENT, f"level={self.level}", *rooms, *self.settings)

    def on_device(self) -> tuple[str, ...]:
        """Overrides that say where it is computed."""
        return (f"trainer.accelerator={self.device}", "trainer.devices=1")


class AccuracyFolder:
    """The folder of one plan.

    ``plan.json``; ``speeds/<row>.json``: what an epoch takes; ``runs/<row>/seed_<n>``: the weights,
    a log and ``run.json`` with the training and its evaluations.

    Args:
        path: It.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(self, plan: Plan) -> None:
        """Write down the plan of a new folder; check that of one that is there.

        Raises:
            SettingError: Another plan was begun there.
        """
        file = self.path / "plan.json"
        if file.exists() and self.plan() != plan:
            raise SettingError(
                "--output",
                found=f"{self.path}, begun with {_said(self.plan())}",
                expected=f"one with {_said(plan)}",
                remedy="Give another folder, or the options that this one was begun with.",
            )
        _write(file, asdict(plan))

    def plan(self) -> Plan:
        """The plan it was begun with."""
        content = _read(self.path / "plan.json") or {}
        return Plan(**content | {"settings": tuple(content["settings"])})

    def run_folder(self, row: Row, seed: int) -> Path:
        """Where a run is."""
        return self.path / "runs" / row.name / f"seed_{seed}"

    def speed(self, row: Row) -> dict[str, Any] | None:
        """What an epoch of a row takes; None if it was not measured yet.

        Raises:
            SettingError: It was, with other settings.
        """
        return self._of_row(self._speed_file(row), row)

    def write_speed(self, row: Row, measured: dict[str, Any]) -> None:
        """Keep what was measured."""
        _write(self._speed_file(row), {"settings": list(row.settings), **measured})

    def epochs(self, row: Row) -> int:
        """Epochs of a row whose speed is known: about as long as planned, one at least."""
        speed = self.speed(row) or {}
        return max(1, round(self.plan().seconds / speed["epoch_seconds"]))

    def run(self, row: Row, seed: int) -> dict[str, Any] | None:
        """What is known of a run; None if it was not trained yet.

        Raises:
            SettingError: It was, with other settings.
        """
        return self._of_row(self.run_folder(row, seed) / "run.json", row)

    def write_run(self, row: Row, seed: int, content: dict[str, Any]) -> None:
        """Keep what is known of a run."""
        run = {"settings": list(row.settings), **content}
        _write(self.run_folder(row, seed) / "run.json", run)

    def lacking(self, row: Row, seed: int) -> list[tuple[Variant, str]]:
        """Evaluations of a run that are not done yet, by variant and orientation."""
        run = self.run(row, seed) or {"evaluations": {}}
        return [
            (variant, orientation)
            for variant in (PLAIN, *row.variants)
            for orientation in variant.orientations
            if orientation not in results_of(run, variant)
        ]

    def _speed_file(self, row: Row) -> Path:
        return self.path / "speeds" / f"{row.name}.json"

    def _of_row(self, file: Path, row: Row) -> dict[str, Any] | None:
        content = _read(file)
        if content is not None and content["settings"] != list(row.settings):
            raise SettingError(
                str(file),
                found=f"'{row.name}' with the settings {' '.join(content['settings']) or 'none'}",
                expected=" ".join(row.settings) or "none",
                remedy="The row has changed: remove its results, or choose another --output.",
            )
        return content


def results_of(run: dict[str, Any], variant: Variant) -> dict[str, Any]:
    """Results of a run by orientation; those of a variant of other settings do not count."""
    found = run["evaluations"].get(variant.name)
    if found is None or found["settings"] != list(variant.settings):
        return {}
    results: dict[str, Any] = found["results"]
    return results


def _said(plan: Plan) -> str:
    return ", ".join(f"{name} {value}" for name, value in asdict(plan).items() if value != ())


def _read(file: Path) -> dict[str, Any] | None:
    return json.loads(file.read_text()) if file.exists() else None


def _write(file: Path, content: dict[str, Any]) -> None:
    write_text(file, json.dumps(content, indent=1) + "\n")
