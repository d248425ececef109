"""The record of an evaluation: its data and settings, scores and files.

A finished run holds it as ``results.json`` beside its settings, ``config.yaml``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tangent_train.checkpoints.content import INPUTS, read_settings
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.metrics.segmentation import Interval
from tangent_train.registry import Text, check_fields
from tangent_train.setting_rules import flat_settings

RESULTS_FILE = "results.json"

_Value = TypeVar("_Value")

Band = tuple[float, ...]
"""South and north of a latitude band, in degrees."""

SOLID_ANGLE = "_solid_angle"
"""Ends the name of a score by solid angle; the same score by pixels has the name without it."""


class Heading(NamedTuple):
    """How reports show a score.

    Attributes:
        text: Name of the score.
        unit: ``%`` for a share of 1, which is shown in percent; else a unit, or "".
        of_class: Name of the score of one class that it is the mean of; "" if there is none.
        class_text: Name of that score in reports.
    """

    text: str
    unit: str = "%"
    of_class: str = ""
    class_text: str = ""

    @property
    def column(self) -> str:
        """Heading of a column with the score."""
        return f"{self.text} {self.unit}".strip()

    @property
    def class_column(self) -> str:
        """Heading of a column with the score of one class."""
        return f"{self.class_text} {self.unit}".strip()


def by_solid_angle(scores: Mapping[str, _Value]) -> dict[str, _Value]:
    """Name scores as those by solid angle."""
    return {name + SOLID_ANGLE: value for name, value in scores.items()}


def with_solid_angle(headings: Mapping[str, Heading]) -> dict[str, Heading]:
    """Add the headings of the same scores by solid angle.

    Args:
        headings: Headings of scores by pixels.
    """
    return dict(headings) | {
        name + SOLID_ANGLE: Heading(
            f"{heading.text} by solid angle",
            heading.unit,
            heading.of_class and heading.of_class + SOLID_ANGLE,
            heading.class_text and f"{heading.class_text} by solid angle",
        )
        for name, heading in headings.items()
    }


_SHOWN = {
    "data.fold": int | None,
    "data.inputs": INPUTS | None,
    "level": int | None,
    "representation.base_level": int | None,
    "seed": int | None,
}
"""Types of the settings that reports show."""

_FIELDS = {
    "noun": Text,
    "images": int,
    "headings": dict[str, dict[str, Text]],
    "classes": list,
    "latitude_bands": list,
    "confusion": list[list[int]],
    "intervals": dict[str, list[float]],
    "checkpoint": Text,
    "class_map": Text | None,
}
_HEADING: dict[str, Any] = dict.fromkeys(Heading._fields, Text)
_EXPECTED = "results written by tangent-train or tangent-evaluate"


@dataclass(frozen=True)
class Record:
    """One evaluation. Scores are numbers, shares of 1 or of another unit; None where undefined.

    Attributes:
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        headings: Headings of all scores, in the order of the tables.
        means: Scores over all images, the main score first: charts and latitudes show it.
        classes: For every class its name (``class``) and scores; empty without classes.
        latitude_bands: For every band ``latitude_deg`` (south, north) and scores; empty for photos.
        confusion: Integer counts, rows truth, columns prediction; empty without classes.
        intervals: 95 % bootstrap intervals over the images, of those means that have one.
        checkpoint: File of the network; that of a run itself is relative to its folder.
        class_map: File or name of the map to the classes of the data; None for its own classes.
        settings: The resolved config of the run, as ``section.setting``.
        folder: Folder of the run.
    """

    noun: str
    images: int
    headings: Mapping[str, Heading]
    means: Mapping[str, float | None]
    classes: Sequence[Mapping[str, Any]] = ()
    latitude_bands: Sequence[Mapping[str, Any]] = ()
    confusion: Sequence[Sequence[int]] = ()
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    checkpoint: str = ""
    class_map: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        """Refuse a score that would hide a field of the file."""
        if clash := self.means.keys() & _FIELDS.keys():
            raise ValueError(f"a score cannot have the name {', '.join(sorted(clash))}")

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(entry["class"] for entry in self.classes)

    @property
    def main(self) -> str:
        """Name of the main score."""
        return next(iter(self.means))

    @property
    def main_of_class(self) -> str:
        """Name of the main score of a class; "" without classes."""
        return next(filter(None, (self.headings[name].of_class for name in self.means)), "")

    @property
    def class_means(self) -> dict[str, str]:
        """Names of the scores of one class, in the order of the tables, with those of the means."""
        return {h.of_class: name for name, h in self.headings.items() if h.of_class}

    @property
    def absent(self) -> tuple[str, ...]:
        """Classes that do not occur in the labels, so that the means leave them out."""
        return tuple(e["class"] for e in self.classes if e[self.main_of_class] is None)

    @property
    def bands(self) -> tuple[Band, ...]:
        """The latitude bands."""
        return tuple(tuple(entry["latitude_deg"]) for entry in self.latitude_bands)

    @property
    def data(self) -> str:
        """The data set, and how the test images were rotated, and turned upright."""
        name = str(self.settings.get("data._target_")).rpartition(".")[2]
        rotation = self.settings.get("data.test_rotation")
        if rotation is None or self.settings.get("data.inputs") is None:  # shapes
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
            name: Name of the score.
            part: Name of a class, or a band.

        Returns:
            None where it is undefined, or there is no such part.
        """
        parts: dict[Any, Mapping[str, Any]] = {None: self.means}
        parts |= zip(self.class_names, self.classes, strict=True)
        parts |= zip(self.bands, self.latitude_bands, strict=True)
        return parts.get(part, {}).get(name)

    def json(self) -> str:
        """The content of ``results.json``."""
        content = {name: getattr(self, name) for name in _FIELDS}
        content["headings"] = {name: h._asdict() for name, h in self.headings.items()}
        return json.dumps({**self.means, **content}, indent=1) + "\n"


def load_record(folder: Path) -> Record:
    """Read the results and settings of a finished run.

    Args:
        folder: Folder of the run.

    Raises:
        DataError: A file is missing, or is not what ``tangent-train`` writes.
    """
    path = folder / RESULTS_FILE
    content = read_json(path, _EXPECTED)
    found = check_fields(path, content, _FIELDS, _EXPECTED)
    found["headings"] = headings = {
        name: Heading(**check_fields(path, entry, _HEADING, _EXPECTED, f"headings.{name}"))
        for name, entry in found["headings"].items()
    }
    of_class = (heading.of_class for heading in headings.values())
    parts: dict[str, dict[str, Any]] = {
        "classes": {**dict.fromkeys(of_class, float | None), "class": Text},
        "latitude_bands": {**dict.fromkeys(headings, float | None), "latitude_deg": list[float]},
    }
    for part, kinds in parts.items():
        for entry in found[part]:
            check_fields(path, entry, kinds, _EXPECTED, part)
    kinds = {name: float | None for name in content if name in headings}  # the main one first
    found["means"] = check_fields(path, content, kinds, _EXPECTED)
    if not kinds:
        raise DataError(path, found="no score with a heading", expected=_EXPECTED)
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
