"""The record of an evaluation: its data and settings, scores and files.

A finished run holds it as ``results.json`` beside its settings, ``config.yaml``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tangent_train.checkpoints.content import INPUTS, read_settings
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.metrics.segmentation import AbsentClass, Interval
from tangent_train.registry import Text, check_fields
from tangent_train.setting_rules import flat_settings

RESULTS_FILE = "results.json"

Kind = Literal["segmentation", "classification"]
Band = tuple[float, ...]
"""South and north of a latitude band, in degrees."""


class Scores(NamedTuple):
    """The scores of a kind of task, by name, with their headings.

    Attributes:
        means: Over all classes.
        per_class: Of one class.
        mean_of: The mean over the classes of each score of one class.
        per_band: Of a latitude band.
        charted: The score per class that a chart shows.
    """

    means: Mapping[str, str]
    per_class: Mapping[str, str]
    mean_of: Mapping[str, str]
    per_band: Sequence[str]
    charted: str


def with_solid_angle(
    by_pixels: Mapping[str, Any], by_angle: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Scores by pixels, and those by solid angle under their names; or the headings of both."""
    if by_angle is None:
        by_angle = {name: f"{heading} by solid angle" for name, heading in by_pixels.items()}
    return {**by_pixels, **{f"{name}_solid_angle": value for name, value in by_angle.items()}}


SCORES: Mapping[str, Scores] = {
    "segmentation": Scores(
        with_solid_angle({"macc": "mAcc", "miou": "mIoU"}),
        with_solid_angle({"accuracy": "accuracy", "iou": "IoU"}),
        with_solid_angle(
            {"accuracy": "macc", "iou": "miou"},
            {"accuracy": "macc_solid_angle", "iou": "miou_solid_angle"},
        ),
        ("macc", "miou"),
        "iou",
    ),
    "classification": Scores(
        {"accuracy": "accuracy", "class_accuracy": "mean of the classes"},
        {"accuracy": "accuracy"},
        {"accuracy": "class_accuracy"},
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

_FIELDS = {
    "kind": Kind,
    "noun": Text,
    "images": int,
    "classes": list,
    "latitude_bands": list,
    "confusion": list[list[int]],
    "absent_class": AbsentClass | None,
    "intervals": dict[str, list[float]],
    "checkpoint": Text,
    "class_map": Text | None,
}
_EXPECTED = "results written by tangent-train or tangent-evaluate"


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
    def absent(self) -> tuple[str, ...]:
        """Classes that no label has, so that the means leave them out."""
        return tuple(entry["class"] for entry in self.classes if entry["accuracy"] is None)

    @property
    def bands(self) -> tuple[Band, ...]:
        """The latitude bands."""
        return tuple(tuple(entry["latitude_deg"]) for entry in self.latitude_bands)

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
        parts: dict[Any, Mapping[str, Any]] = {None: self.means}
        parts |= zip(self.class_names, self.classes, strict=True)
        parts |= zip(self.bands, self.latitude_bands, strict=True)
        return parts.get(part, {}).get(name)

    def json(self) -> str:
        """The content of ``results.json``."""
        content = {f.name: getattr(self, f.name) for f in fields(self) if f.name in _FIELDS}
        return json.dumps({**self.means, **content}, indent=1) + "\n"


def load_record(folder: Path) -> Record:
    """Read the results and settings of a finished run.

    Args:
        folder: Of the run.

    Raises:
        DataError: A file is missing, or is not what ``tangent-train`` writes.
    """
    path = folder / RESULTS_FILE
    content = read_json(path, _EXPECTED)
    found = check_fields(path, content, _FIELDS, _EXPECTED)
    scores = SCORES[found["kind"]]
    kinds_of: dict[str, dict[str, Any]] = {
        "classes": {"class": Text, **dict.fromkeys(scores.per_class, float | None)},
        "latitude_bands": {
            "latitude_deg": list[float],
            **dict.fromkeys(scores.per_band, float | None),
        },
    }
    for part, kinds in kinds_of.items():
        for entry in found[part]:
            check_fields(path, entry, kinds, _EXPECTED, part)
    found["means"] = check_fields(
        path, content, dict.fromkeys(scores.means, float | None), _EXPECTED
    )
    path = folder / "config.yaml"
    settings = dict(flat_settings(read_settings(path)))
    check_fields(path, settings, _SHOWN, "the settings of a run")
    return Record(**found, settings=settings, folder=folder)


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
