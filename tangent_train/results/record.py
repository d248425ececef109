"""The record of an evaluation: its data and settings, scores and files.

A finished run holds it as ``results.json`` beside its settings, ``config.yaml``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tangent_train.checkpoints.content import INPUTS, read_settings
from tangent_train.errors import DataError
from tangent_train.files import parse_json
from tangent_train.metrics.segmentation import Interval
from tangent_train.registry import check_fields
from tangent_train.setting_rules import flat_settings

__all__ = [
    "RESULTS_FILE",
    "SCORES",
    "Band",
    "Kind",
    "Record",
    "Scores",
    "find_runs",
    "load_record",
    "unfinished_runs",
]

RESULTS_FILE = "results.json"

Kind = Literal["segmentation", "classification"]
Band = tuple[float, float]
"""South and north of a latitude band, in degrees."""


class Scores(NamedTuple):
    """The scores of a kind of task, by name, with their headings.

    Attributes:
        means: Over all classes.
        per_class: Of one class.
        per_band: Of a latitude band.
        worst: The score per class that says which class is the worst.
    """

    means: Mapping[str, str]
    per_class: Mapping[str, str]
    per_band: Sequence[str]
    worst: str


SCORES: Mapping[str, Scores] = {
    "segmentation": Scores(
        {
            "macc": "mAcc",
            "miou": "mIoU",
            "macc_solid_angle": "mAcc by solid angle",
            "miou_solid_angle": "mIoU by solid angle",
        },
        {
            "accuracy": "accuracy",
            "iou": "IoU",
            "accuracy_solid_angle": "accuracy by solid angle",
            "iou_solid_angle": "IoU by solid angle",
        },
        ("macc", "miou"),
        "iou",
    ),
    "classification": Scores(
        {"accuracy": "accuracy", "class_accuracy": "mean of the classes"},
        {"accuracy": "accuracy"},
        (),
        "accuracy",
    ),
}
"""By kind of task."""

_SHOWN = {
    "data.fold": int | None,
    "data.inputs": INPUTS | None,
    "level": int | None,
    "representation.base_level": int | None,
    "seed": int | None,
}
"""Types of the settings that reports show."""


@dataclass(frozen=True)
class Record:
    """One evaluation. Scores are shares of 1, not percent; None where they are undefined.

    Attributes:
        kind: Kind of the task.
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        means: Scores over all classes, see `SCORES`.
        classes: For every class its name (``class``) and scores.
        latitude_bands: For every band ``latitude_deg`` (south, north) and scores; none for photos.
        confusion: Integer counts, rows truth, columns prediction.
        absent_class: Treatment of classes absent from the ground truth in the means.
        intervals: 95 % bootstrap intervals over the images, of those means that have one.
        checkpoint: File of the network; that of a run itself is relative to its folder.
        class_map: What gave the network the classes of the data; None for its own classes.
        settings: The resolved config of the run, as ``section.setting``.
        folder: Of the run.
    """

    kind: Kind
    noun: str
    images: int
    means: Mapping[str, float | None]
    classes: Sequence[Mapping[str, Any]]
    latitude_bands: Sequence[Mapping[str, Any]] = ()
    confusion: Sequence[Sequence[int]] = ()
    absent_class: str | None = None
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    checkpoint: str = ""
    class_map: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(entry["class"] for entry in self.classes)

    @property
    def bands(self) -> tuple[Band, ...]:
        """The latitude bands."""
        return tuple(_edges(entry) for entry in self.latitude_bands)

    @property
    def data(self) -> str:
        """The data set, and how the test images were rotated, and turned upright."""
        name = str(self.settings.get("data._target_")).rpartition(".")[2]
        rotation = self.settings.get("data.test_rotation")
        if rotation is None or self.kind != "segmentation":
            return name
        upright = self.settings.get("data.upright")
        aligned = "" if upright is None else f", upright: {upright}"
        return f"{name}, test rotated: {rotation}{aligned}"

    @property
    def fold(self) -> int | None:
        """The fold that was tested; None for data without folds."""
        return self.settings.get("data.fold")

    @property
    def seed(self) -> int | None:
        """The seed of the run."""
        return self.settings.get("seed")

    def score(self, name: str, part: str | Band | None = None) -> float | None:
        """A score over all classes, of a class, or of a latitude band.

        Args:
            name: See `SCORES`.
            part: Name of a class, or a band.

        Returns:
            A share of 1; None where it is undefined, or there is no such part.
        """
        source: Mapping[str, Any] = self.means
        if isinstance(part, str):
            source = next((entry for entry in self.classes if entry["class"] == part), {})
        elif part is not None:
            source = next((e for e in self.latitude_bands if _edges(e) == part), {})
        return source.get(name)

    def json(self) -> str:
        """The content of ``results.json``."""
        content = {
            "kind": self.kind,
            "noun": self.noun,
            "images": self.images,
            "checkpoint": self.checkpoint,
            "class_map": self.class_map,
            **self.means,
            **({"intervals": self.intervals} if self.intervals else {}),
            **({} if self.absent_class is None else {"absent_class": self.absent_class}),
            "classes": self.classes,
            "latitude_bands": self.latitude_bands,
            "confusion": self.confusion,
        }
        return json.dumps(content, indent=1) + "\n"


def load_record(folder: Path) -> Record:
    """Read the results and settings of a finished run.

    Args:
        folder: Of the run.

    Raises:
        DataError: A file is missing, or is not what ``tangent-train`` writes.
    """
    path = folder / RESULTS_FILE
    expected = "results written by tangent-train or tangent-evaluate"
    try:
        record = _parsed(parse_json(path.read_text()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        found = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise DataError(path, found=found, expected=expected) from error
    path = folder / "config.yaml"
    settings = dict(flat_settings(read_settings(path)))
    check_fields(path, settings, _SHOWN, "the settings of a run")
    return Record(**record, settings=settings, folder=folder)


def _parsed(content: Any) -> dict[str, Any]:
    """The fields of a record that come from its results; all scores must be there."""
    scores = SCORES[content["kind"]]
    means = {name: _share(content[name]) for name in scores.means}
    classes, bands = list(content["classes"]), list(content["latitude_bands"])
    for entry in classes:
        _ = str(entry["class"]), [_share(entry[name]) for name in scores.per_class]
    for entry in bands:
        _ = _edges(entry), [_share(entry[name]) for name in scores.per_band]
    for name, kinds in {"images": int, "checkpoint": str, "class_map": str | None}.items():
        if not isinstance(content[name], kinds):
            raise TypeError(f"{name}={content[name]!r}")
    kept = ("kind", "noun", "images", "checkpoint", "class_map", "confusion")
    return {
        **{name: content[name] for name in kept},
        "absent_class": content.get("absent_class"),
        "intervals": {k: _interval(v) for k, v in content.get("intervals", {}).items()},
        "means": means,
        "classes": classes,
        "latitude_bands": bands,
    }


def _share(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise ValueError(f"{value!r} instead of a share of 1, or null")
    return float(value)


def _interval(value: Any) -> Interval:
    low, high = map(_share, value)
    if low is None or high is None:
        raise ValueError(f"{value!r} instead of two shares of 1")
    return low, high


def _edges(band: Mapping[str, Any]) -> Band:
    south, north = map(float, band["latitude_deg"])
    if math.isnan(south + north):
        raise ValueError("a latitude is NaN")
    return south, north


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """The folders of finished runs in and below the given ones, each once, sorted within each.

    Raises:
        DataError: A folder is missing or holds no results.
    """
    found: dict[Path, None] = {}
    for folder in folders:
        if not folder.is_dir():
            raise DataError(folder, found="no such folder", expected="a run, or a folder of runs")
        inside = [folder] if (folder / RESULTS_FILE).exists() else _below(folder, RESULTS_FILE)
        if not inside:
            begun = (folder / "checkpoints").is_dir()
            raise DataError(
                folder / RESULTS_FILE,
                found="no such file, nor any below",
                expected="the results of a finished run",
                remedy=f"Finish it: tangent-train resume={folder}" if begun else "",
            )
        found.update(dict.fromkeys(path.resolve() for path in inside))
    return list(found)


def unfinished_runs(folders: Sequence[Path]) -> list[Path]:
    """Folders of started runs without results, in and below the given ones."""
    begun = [path for folder in folders for path in _below(folder, "checkpoints")]
    return sorted({path.resolve() for path in begun if not (path / RESULTS_FILE).exists()})


def _below(folder: Path, name: str) -> list[Path]:
    return sorted(path.parent for path in folder.rglob(name))
