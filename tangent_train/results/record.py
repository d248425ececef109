"""The record of an evaluation: its data, settings and scores.

The folder of a finished run contains it as ``results.json``, and the settings as ``config.yaml``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tangent_train.checkpoints.content import INPUTS, read_settings
from tangent_train.config.build import Text, check_fields
from tangent_train.config.setting_rules import flat_settings
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.metrics.segmentation import Interval

RESULTS_FILE = "results.json"

_Value = TypeVar("_Value")

Band = tuple[float, ...]
"""South and north of a latitude band, in degrees."""

SOLID_ANGLE = "_solid_angle"
"""Suffix of the name of a score by solid angle; without it, it is the name of the same score by
pixels."""


class Heading(NamedTuple):
    """Name and unit of a score in reports.

    Attributes:
        text: Name of the score in reports.
        unit: ``%`` for a share of 1, which is printed in percent; else a unit, or "".
        of_class: Key of the score of one class that this score is the mean of, or "".
        class_text: Name of that score in reports.
        better: ``higher``, or ``lower`` for errors.
        is_main: True if reports of several runs and headlines contain the score; all scores are in
            the files and in the tables of a run.
    """

    text: str
    unit: str = "%"
    of_class: str = ""
    class_text: str = ""
    better: str = "higher"
    is_main: bool = True

    @property
    def column(self) -> str:
        """Heading of a column with the score."""
        return f"{self.text} {self.unit}".strip() + " ↓" * (self.better == "lower")

    @property
    def class_column(self) -> str:
        """Heading of a column with the score of one class."""
        return f"{self.class_text} {self.unit}".strip()


def by_solid_angle(scores: Mapping[str, _Value]) -> dict[str, _Value]:
    """Rename scores to those by solid angle."""
    return {name + SOLID_ANGLE: value for name, value in scores.items()}


def with_solid_angle(headings: Mapping[str, Heading]) -> dict[str, Heading]:
    """Add the headings of the same scores by solid angle.

    Args:
        headings: Headings of scores by pixels.
    """
    return dict(headings) | {
        name + SOLID_ANGLE: heading._replace(
            text=f"{heading.text} by solid angle",
            of_class=heading.of_class and heading.of_class + SOLID_ANGLE,
            class_text=heading.class_text and f"{heading.class_text} by solid angle",
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
"""Settings that reports print, with their kinds."""

_FIELDS = {
    "noun": Text,
    "images": int,
    "headings": dict[str, dict[str, Text | bool]],
    "classes": list,
    "latitude_bands": list,
    "groups": list,
    "confusion": list[list[int]],
    "intervals": dict[str, list[float]],
    "protocol": dict[str, Text],
    "checkpoint": Text,
    "label_map": Text | None,
}
_HEADING: dict[str, Any] = dict.fromkeys(Heading._fields, Text) | {"is_main": bool}
_EXPECTED = "results written by tangent-train or tangent-evaluate"


@dataclass(frozen=True)
class Record:
    """One evaluation. Scores are shares of 1, or in a unit; None if undefined.

    Attributes:
        noun: Plural name of the images: panoramas, photos, shapes.
        images: Number of images.
        headings: Headings of all scores, in the order of the tables.
        means: Scores over all images. The first is the main score, used by charts and latitudes.
        classes: Name (``class``) and scores of each class; empty without classes.
        latitude_bands: Edges ``latitude_deg`` (south, north) and scores of each band; empty for
            photos.
        groups: Name (``group``), number of ``images`` and scores of groups of images, such as
            weathers; empty for data without groups.
        confusion: Counts; rows are true, columns predicted classes. Empty without classes.
        intervals: 95 % bootstrap intervals over the images, for means that have one.
        protocol: Facts that make scores comparable, see `results.published`.
        checkpoint: File of the network, relative to the run folder if it is inside.
        label_map: File or name of the map to the classes of the data; None without a map.
        settings: Resolved config of the run, with names ``section.setting``.
        folder: Run folder.
    """

    noun: str
    images: int
    headings: Mapping[str, Heading]
    means: Mapping[str, float | None]
    classes: Sequence[Mapping[str, Any]] = ()
    latitude_bands: Sequence[Mapping[str, Any]] = ()
    groups: Sequence[Mapping[str, Any]] = ()
    confusion: Sequence[Sequence[int]] = ()
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    protocol: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    label_map: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        """Refuse a score with the name of a field of the file."""
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
    def main_headings(self) -> dict[str, Heading]:
        """Headings of the main scores, see `Heading.is_main`."""
        return {name: heading for name, heading in self.headings.items() if heading.is_main}

    @property
    def class_means(self) -> dict[str, str]:
        """Names of the means by the scores of one class, in the order of the tables."""
        return {h.of_class: name for name, h in self.headings.items() if h.of_class}

    @property
    def absent(self) -> tuple[str, ...]:
        """Classes that do not occur in the labels and are left out of the means."""
        return tuple(e["class"] for e in self.classes if e[self.main_of_class] is None)

    @property
    def bands(self) -> tuple[Band, ...]:
        """Latitude bands."""
        return tuple(tuple(entry["latitude_deg"]) for entry in self.latitude_bands)

    @property
    def data(self) -> str:
        """Name of the data set, with rotation and gravity alignment of the test images."""
        name = str(self.settings.get("data._target_")).rpartition(".")[2]
        rotation = self.settings.get("data.test_rotation")
        if rotation is None or self.settings.get("data.inputs") is None:  # shapes
            return name
        upright = self.settings.get("data.upright")
        aligned = "" if upright is None else f", upright: {upright}"
        return f"{name}, test rotated: {rotation}{aligned}"

    @property
    def fold(self) -> int | None:
        """Test fold; None for data without folds."""
        return self.settings.get("data.fold")

    @property
    def seed(self) -> int | None:
        """Seed of the run."""
        return self.settings.get("seed")

    def score(self, name: str, part: str | Band | None = None) -> float | None:
        """Return a score over all images, of a class, or of a latitude band.

        Args:
            name: Name of the score.
            part: Name of a class, or a band; None for all images.

        Returns:
            Score; None if it is undefined, or the part does not exist.
        """
        parts: dict[Any, Mapping[str, Any]] = {None: self.means}
        parts |= zip(self.class_names, self.classes, strict=True)
        parts |= zip(self.bands, self.latitude_bands, strict=True)
        return parts.get(part, {}).get(name)

    def json(self) -> str:
        """Return the content of ``results.json``."""
        content = {name: getattr(self, name) for name in _FIELDS}
        content["headings"] = {name: h._asdict() for name, h in self.headings.items()}
        return json.dumps({**self.means, **content}, indent=1) + "\n"


def load_record(folder: Path) -> Record:
    """Read the results and settings of a finished run.

    Args:
        folder: Run folder.

    Raises:
        DataError: A file is missing, or was not written by ``tangent-train``.
    """
    path = folder / RESULTS_FILE
    content = read_json(path, _EXPECTED)
    values = check_fields(path, content, _FIELDS, _EXPECTED)
    values["headings"] = headings = {
        name: Heading(**check_fields(path, entry, _HEADING, _EXPECTED, f"headings.{name}"))
        for name, entry in values["headings"].items()
    }
    of_class = (heading.of_class for heading in headings.values())
    parts: dict[str, dict[str, Any]] = {
        "classes": {**dict.fromkeys(of_class, float | None), "class": Text},
        "latitude_bands": {**dict.fromkeys(headings, float | None), "latitude_deg": list[float]},
        "groups": {**dict.fromkeys(headings, float | None), "group": Text, "images": int},
    }
    for part, kinds in parts.items():
        for entry in values[part]:
            check_fields(path, entry, kinds, _EXPECTED, part)
    # In the order of the file: the main score is the first.
    kinds = {name: float | None for name in content if name in headings}
    values["means"] = check_fields(path, content, kinds, _EXPECTED)
    if not kinds:
        raise DataError(path, found="no score with a heading", expected=_EXPECTED)
    path = folder / "config.yaml"
    settings = dict(flat_settings(read_settings(path)))
    check_fields(path, settings, _SHOWN, "the settings of a run")
    return Record(**values, settings=settings, folder=folder)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Find finished runs in and below folders; return each once, sorted within each folder.

    Raises:
        DataError: A folder is missing or contains no results.
    """
    runs: dict[Path, None] = {}
    for folder in folders:
        if not folder.is_dir():
            raise DataError(folder, found="no such folder", expected="a run, or a folder of runs")
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
