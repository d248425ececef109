"""Finished runs on disk: their results and settings, read and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from tangent_train.checkpoints.content import INPUTS, read_settings
from tangent_train.errors import DataError
from tangent_train.json_text import parse_json
from tangent_train.registry import check_fields
from tangent_train.setting_rules import flat_settings

__all__ = [
    "FIGURES",
    "MEANS",
    "PER_BAND",
    "PER_CLASS",
    "RESULTS_FILE",
    "Figures",
    "Run",
    "find_runs",
    "load_run",
    "unfinished_runs",
]

RESULTS_FILE = "results.json"

MEANS = ("miou", "macc", "miou_solid_angle", "macc_solid_angle")
"""Figures over all classes, as named in the results."""

PER_CLASS = ("iou", "accuracy", "iou_solid_angle", "accuracy_solid_angle")
"""Figures of a class, likewise."""

PER_BAND = ("miou", "macc")
"""Figures of a band of latitude, likewise."""


class Figures(NamedTuple):
    """What results of one kind hold.

    Attributes:
        means: Figures over all classes, as named in the results.
        per_class: Figures of a class, likewise.
        worst: The one of them by which a class is the worst.
        per_band: Figures of a band of latitude, likewise.
    """

    means: tuple[str, ...]
    per_class: tuple[str, ...]
    worst: str
    per_band: tuple[str, ...] = ()


FIGURES: Mapping[str, Figures] = {
    "segmentation": Figures(MEANS, PER_CLASS, "iou", PER_BAND),
    "classification": Figures(("accuracy", "class_accuracy"), ("accuracy",), "accuracy"),
}
"""By the kind of the task."""


_SHOWN = {
    "data.fold": int | None,
    "data.inputs": INPUTS | None,
    "level": int | None,
    "representation.base_level": int | None,
    "seed": int | None,
}
"""What settings in reports have to be."""


@dataclass(frozen=True)
class Run:
    """A finished run or evaluation.

    Attributes:
        folder: Where it is.
        settings: Its resolved config, ``section.setting`` → value.
        results: Its ``results.json``.
    """

    folder: Path
    settings: Mapping[str, Any]
    results: Mapping[str, Any]

    @property
    def fold(self) -> int | None:
        """The fold it was tested on; None for data without folds."""
        fold = self.settings.get("data.fold")
        return None if fold is None else int(fold)

    @property
    def kind(self) -> str:
        """What was learned, a key of `FIGURES`."""
        return _kind(self.results)

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes of its results."""
        return tuple(entry["class"] for entry in self.results["classes"])

    @property
    def images(self) -> int:
        """How many panoramas or photos were scored."""
        return int(self.results["images"])

    @property
    def bands(self) -> tuple[tuple[float, float], ...]:
        """Its bands of latitude, (south, north) in degrees; none for photos."""
        return tuple(_edges(entry) for entry in self.results.get("latitude_bands") or ())

    def figure(
        self,
        name: str,
        class_index: int | None = None,
        band: tuple[float, float] | None = None,
    ) -> float | None:
        """A figure of all classes, of one, or of a band of latitude.

        Args:
            name: One of the means of its kind, see `FIGURES`; of its figures per class with a
                class, of those per band with a band.
            class_index: Which class.
            band: Which band, as in `bands`.

        Returns:
            A share of 1; None where it is not defined, or there is no such band.
        """
        source: Mapping[str, Any] = self.results
        if class_index is not None:
            source = self.results["classes"][class_index]
        elif band is not None:
            entries = self.results.get("latitude_bands") or ()
            source = next((entry for entry in entries if _edges(entry) == band), {name: None})
        value = source[name]
        return None if value is None or math.isnan(value) else float(value)


def _kind(results: Mapping[str, Any]) -> str:
    return str(results.get("kind", "segmentation"))  # which older results do not say


def _edges(band: Mapping[str, Any]) -> tuple[float, float]:
    south, north = band["latitude_deg"]
    return float(south), float(north)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """The folders of runs in and below the given ones, each once, sorted within each.

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
                found="no such file" + ("" if begun else ", nor any below"),
                expected="the results of a finished run",
                remedy=f"Finish it: tangent-train resume={folder}" if begun else "",
            )
        found.update(dict.fromkeys(path.resolve() for path in inside))
    return list(found)


def unfinished_runs(folders: Sequence[Path]) -> list[Path]:
    """Folders of runs in and below the given ones that have begun and have no results."""
    begun = [path for folder in folders for path in _below(folder, "checkpoints")]
    return sorted({path.resolve() for path in begun if not (path / RESULTS_FILE).exists()})


def _below(folder: Path, name: str) -> list[Path]:
    return sorted(path.parent for path in folder.rglob(name))


def load_run(folder: Path) -> Run:
    """Read a run's results and settings.

    Raises:
        DataError: One of the files is missing or not what ``tangent-train`` writes.
    """
    results = _results(folder / RESULTS_FILE)
    path = folder / "config.yaml"
    settings = dict(flat_settings(read_settings(path)))
    check_fields(path, settings, _SHOWN, "the settings of a run")
    return Run(folder, settings, results)


def _results(path: Path) -> dict[str, Any]:
    expected = "results written by tangent-train or tangent-evaluate"
    if not path.is_file():
        raise DataError(path, found="no such file", expected=expected)
    try:
        results = parse_json(path.read_text())
        figures = _figures(results)
    except (OSError, ValueError) as error:
        raise DataError(path, found=_first_line(error), expected=expected) from error
    except KeyError as error:
        raise DataError(path, found=f"no {error}", expected=expected) from error
    except (AttributeError, TypeError) as error:
        raise DataError(path, found="other lists and mappings", expected=expected) from error
    for value in figures:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (number and 0 <= value <= 1):
            raise DataError(path, found=f"{value!r}", expected="shares of 1, or null")
    return dict(results)


def _figures(results: Mapping[str, Any]) -> list[Any]:
    """All figures that results of their kind must have."""
    if _kind(results) not in FIGURES:
        raise ValueError(f"results of {_kind(results)}")
    names = FIGURES[_kind(results)]
    if type(results["images"]) is not int:
        raise TypeError
    figures = [results[name] for name in names.means]
    for entry in results["classes"]:
        str(entry["class"])
        figures += [entry[name] for name in names.per_class]
    for entry in results.get("latitude_bands") or ():  # photos have none
        _edges(entry)
        figures += [entry[name] for name in names.per_band]
    return figures


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".partition("\n")[0]
