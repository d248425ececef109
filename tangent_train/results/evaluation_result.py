"""The result of an evaluation: its data, settings and scores, stored as ``results.json``.

The folder of a finished run contains it, and the settings as ``config.yaml``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from pydantic import TypeAdapter

from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.metrics.score_columns import ScoreColumn
from tangent_train.metrics.segmentation import Interval

RESULTS_FILE = "results.json"

Band = tuple[float, float]
"""South and north of a latitude band, in degrees."""


@dataclass(frozen=True)
class EvaluationResult:
    """One evaluation. Scores are shares of 1, or in a unit; None if undefined.

    Attributes:
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        columns: Names and units of all scores, in the order of the tables.
        scores: Scores over all images. The first is the main score, used by charts and latitudes.
        classes: Name (``class``) and scores of each class; empty without classes.
        latitude_bands: Edges ``latitude_deg`` (south, north) and scores of each band; empty for
            photos.
        groups: Name (``group``), number of ``images`` and scores of groups of images, such as
            weathers; empty for data without groups.
        confusion: Counts; rows are true, columns predicted classes. Empty without classes.
        intervals: 95 % bootstrap intervals over the images, for scores that have one.
        protocol: Facts that make scores comparable, see `results.published`.
        checkpoint: File of the network, relative to the run folder if it is inside.
        label_map: File or name of the map to the classes of the data; None without a map.
        folds: All folds of the data set; empty for data without folds.
        settings: Resolved config of the run, with names ``section.setting``; not in the file.
        folder: Run folder; not in the file.
    """

    noun: str
    images: int
    columns: Mapping[str, ScoreColumn]
    scores: Mapping[str, float | None]
    classes: Sequence[Mapping[str, Any]] = ()
    latitude_bands: Sequence[Mapping[str, Any]] = ()
    groups: Sequence[Mapping[str, Any]] = ()
    confusion: Sequence[Sequence[int]] = ()
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    protocol: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    label_map: str | None = None
    folds: Sequence[int] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(entry["class"] for entry in self.classes)

    @property
    def main(self) -> str:
        """Name of the main score."""
        return next(iter(self.scores))

    @property
    def main_columns(self) -> dict[str, ScoreColumn]:
        """Columns of the main scores, see `ScoreColumn.is_main`."""
        return {name: column for name, column in self.columns.items() if column.is_main}

    @property
    def class_means(self) -> dict[str, str]:
        """Names of the means by the scores of one class, in the order of the tables."""
        return {c.of_class: name for name, c in self.columns.items() if c.of_class}

    @property
    def main_of_class(self) -> str:
        """Name of the main score of a class; "" without classes."""
        return next(filter(None, (self.columns[name].of_class for name in self.scores)), "")

    @property
    def absent(self) -> tuple[str, ...]:
        """Classes that do not occur in the labels and are left out of the means."""
        return tuple(e["class"] for e in self.classes if e[self.main_of_class] is None)

    @property
    def fold(self) -> int | None:
        """Test fold; None for data without folds."""
        return self.settings.get("data.fold")

    @property
    def seed(self) -> int | None:
        """Seed of the run."""
        return self.settings.get("seed")

    def json(self) -> str:
        """Return the content of ``results.json``."""
        adapter = TypeAdapter(EvaluationResult)
        content = adapter.dump_json(self, indent=1, exclude={"settings", "folder"})
        return content.decode() + "\n"


def flat_settings(config: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return settings of nested sections by name, ``section.setting``."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= flat_settings(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def load_result(folder: Path) -> EvaluationResult:
    """Read the results and settings of a finished run.

    Args:
        folder: Run folder.

    Raises:
        DataError: A file is missing, or was not written by ``tangent-train``.
    """
    expected = "results written by tangent-train or tangent-evaluate"
    result: EvaluationResult = read_json(folder / RESULTS_FILE, expected, kind=EvaluationResult)
    path = folder / "config.yaml"
    try:
        settings = flat_settings(yaml.safe_load(path.read_bytes()))
    except (OSError, yaml.YAMLError) as error:
        raise DataError(path, found=error, expected="the settings of a run") from error
    return replace(result, settings=settings, folder=folder)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Find finished runs in and below folders; return each once, sorted within each folder.

    Raises:
        DataError: A folder contains no results.
    """
    runs: dict[Path, None] = {}
    for folder in folders:
        inside = [folder] if (folder / RESULTS_FILE).exists() else _below(folder, RESULTS_FILE)
        if not inside:
            begun = (folder / "checkpoints").is_dir()
            raise DataError(
                folder / RESULTS_FILE,
                found="no such file, and none below",
                expected="the results of a finished run",
                remedy=f"Finish it: tangent-train resume={folder}" if begun else "",
            )
        runs.update(dict.fromkeys(path.resolve() for path in inside))
    return list(runs)


def unfinished_runs(folders: Sequence[Path]) -> list[Path]:
    """Find runs that were started but have no results, in and below folders."""
    begun = [path for folder in folders for path in _below(folder, "checkpoints")]
    return sorted({path.resolve() for path in begun if not (path / RESULTS_FILE).exists()})


def _below(folder: Path, name: str) -> list[Path]:
    return sorted(path.parent for path in folder.rglob(name))


def plain_scores(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Replace NaN, which JSON lacks, by None."""
    return {name: None if math.isnan(value) else value for name, value in scores.items()}
