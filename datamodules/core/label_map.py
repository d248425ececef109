"""Labels: their kinds, maps from values, colors or names to classes, and weights of the classes.

Label 0 is unknown, and the label of a class is its index plus one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, counted, listed
from tangent_train.files import read_json
from tangent_train.io.image_files import composed
from tangent_train.io.pixel_files import read_pixels, read_rgb

PIXEL_CLASSES = "pixel_classes"
"""Kind of labels: a class for every pixel; 0 is unknown, which is not a class of the network."""

IMAGE_CLASS = "image_class"
"""Kind of labels: one class index for an image or shape."""

DISTANCE = "distance"
"""Kind of labels: a distance from the center for every pixel, in steps of 1/512 m, 0 where
unknown."""

PANOPTIC = "panoptic"
"""Kind of labels: the class and the object of every pixel, see `metrics.panoptic`."""

ClassWeights = Literal["log", "sqrt", "none"]
"""Class weighting of the loss; see `class_weights`."""

UNKNOWN_NAME = "unknown"
"""Name of label 0, pixels without a class."""

Key = int | str
"""A value 0 to 65535; a color ``#ff8000``; or the name of a class, see `plain_name`."""

_REFUSED = 255
_MOST_CLASSES = 254  # labels are uint8, and 0 is unknown
_MOST_VALUE = 65535
_COLOR = re.compile(r"#[0-9a-f]{6}")

_EXPECTED = (
    'a list of class names, ["wall", "floor"], or an object with the values, colors or names of '
    'each class, {"wall": 1, "floor": [2, 3]}, {"wall": "#ff0000"} or {"wall": ["painting"]}, '
    f"every key once; 1 to {_MOST_CLASSES} classes"
)
_LOG_OFFSET = 1.02
_MOST_UNKNOWN = 0.5


@dataclass(frozen=True)
class LabelMap:
    """Labels of values, colors or names.

    Attributes:
        names: Names of the K classes.
        labels: Label of each value, color or name, 0 for unknown.
        refuses_others: True to refuse other values; False to take them for unknown.
    """

    names: tuple[str, ...]
    labels: Mapping[Key, int]
    refuses_others: bool = True

    @classmethod
    def of(
        cls,
        classes: Mapping[str, Key | Sequence[Key]] | Sequence[str],
        unknown: Iterable[Key] = (),
    ) -> Self:
        """Return the map of some classes.

        Args:
            classes: Values, colors or names of each class; or the names of the classes, whose
                values are then 1 to K.
            unknown: Values of pixels without a class.

        >>> LabelMap.of({"car": [7, 8], "bus": 9}, [0]).decode(np.array([0, 7, 8, 9])).tolist()
        [0, 1, 1, 2]
        """
        if not isinstance(classes, Mapping):
            classes = {name: value for value, name in enumerate(classes, start=1)}
        labels = dict.fromkeys(unknown, 0)
        for label, given in enumerate(classes.values(), start=1):
            keys = [given] if isinstance(given, Key) else given
            labels |= dict.fromkeys(keys, label)
        return cls(tuple(classes), labels)

    def regrouped(self, names: Sequence[str], groups: Mapping[str, str] | None = None) -> LabelMap:
        """Return the map from the same values to the classes of a benchmark, by names of classes.

        Args:
            names: Names of the benchmark's classes, which classes of the same name belong to.
            groups: Class of the benchmark by name of other classes. Further classes are unknown.
        """
        label_of = {name: label for label, name in enumerate(names, start=1)}
        label_of = {old: label_of.get(new, 0) for old, new in (groups or {}).items()} | label_of
        of_labels = [0, *(label_of.get(name, 0) for name in self.names)]
        labels = {key: of_labels[label] for key, label in self.labels.items()}
        return LabelMap(tuple(names), labels, self.refuses_others)

    @cached_property
    def in_colors(self) -> bool:
        """True if the keys are colors."""
        return any(isinstance(key, str) for key in self.labels)

    @cached_property
    def _table(self) -> NDArray[np.uint8]:
        """Label of every value or packed color."""
        size = 2**24 if self.in_colors else _MOST_VALUE + 1
        table = np.full(size, _REFUSED if self.refuses_others else 0, np.uint8)
        for key, label in self.labels.items():
            table[int(key[1:], 16) if isinstance(key, str) else key] = label
        return table

    def decode(self, stored: NDArray[np.integer], path: object = "labels") -> NDArray[np.uint8]:
        """Return the labels of a label image.

        Args:
            stored: ``(H, W)`` values, or ``(H, W, 3)`` uint8 colors.
            path: File of the label image, for error messages.

        Returns:
            ``(H, W)``, 0 where unknown.

        Raises:
            DataError: A value is not in the map, which refuses others.
        """
        codes: NDArray[Any] = stored
        if self.in_colors:
            wide = stored.astype(np.int32)
            codes = wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]
        elif stored.dtype.itemsize > 2:
            codes = np.clip(stored, 0, _MOST_VALUE)
        is_bytes = codes.dtype == np.uint8 and codes.size > 0  # then OpenCV is faster
        found: Any = cv2.LUT(codes, self._table[:256]) if is_bytes else self._table[codes]
        labels: NDArray[np.uint8] = found
        if self.refuses_others and labels.max(initial=0) == _REFUSED:
            others = stored[labels == _REFUSED]
            raise DataError(
                path,
                found=f"{listed(np.unique(others).tolist())} in {counted(len(others), 'pixels')}",
                expected=listed(sorted(key for key in self.labels if isinstance(key, int))),
                remedy="Name the values in the label map, e.g. classes.json.",
            )
        return labels

    def read_labels(self, path: Path) -> NDArray[np.uint8]:
        """Return the labels ``(H, W)`` of a label image; the values of a palette are its indices.

        Raises:
            DataError: The file is broken, holds other values, or colors instead of values.
        """
        is_colored = self.in_colors
        stored = read_rgb(path, as_stored=True) if is_colored else read_pixels(path, indices=True)
        if stored.ndim == 3 and not is_colored:
            raise DataError(path, found="colors", expected="values of classes, one per pixel")
        return self.decode(stored, path)


def read_label_map(path: Path) -> LabelMap:
    """Read a label map, e.g. ``classes.json``, in one of these forms.

    * A list of names: the value of a class is its index in the list, from 0. ``null`` instead of a
      name leaves a value without a class. Values past the end of the list are refused, except 255
      (and 65535 of 16 bits), which are unknown::

          [null, "wall", "floor"]

    * An object of names and values (0 to 65535), colors, or names of other classes, one or several.
      Others are unknown::

          {"wall": 1, "floor": [2, 3]}
          {"wall": "#ff0000", "floor": ["#00ff00", "#00ee00"]}
          {"wall": ["wall", "painting"], "floor": ["floor", "rug"]}

    Args:
        path: File to read.

    Raises:
        DataError: The file cannot be read, has another form, or repeats a value.
    """
    content = read_json(path, _EXPECTED)
    if isinstance(content, dict) and isinstance(content.get("classes"), dict):
        content = content["classes"]
    is_list, labels, named = isinstance(content, list), dict[Key, int](), list[tuple[Any, Any]]()
    if is_list:
        named = [(name, value) for value, name in enumerate(content) if name is not None]
    elif isinstance(content, dict):
        named = list(content.items())
    texts = [name for name, _ in named if isinstance(name, str) and name.isprintable()]
    wrong = [json.dumps(n) for n, _ in named if n not in texts or n == UNKNOWN_NAME]
    for label, (name, given) in enumerate(named, start=1):
        for key in given if isinstance(given, list) else [given]:
            plain = plain_name(key) if isinstance(key, str) else key
            is_key = type(key) is str or (type(key) is int and 0 <= key <= _MOST_VALUE)
            if not is_key or plain in labels:
                wrong.append(f"{json.dumps(key)} for {json.dumps(name)}")
            else:
                labels[plain] = label
    names = tuple(composed(str(name)) for name, _ in named)
    kinds = {str if isinstance(key, str) and _COLOR.fullmatch(key) else type(key) for key in labels}
    if wrong or len(kinds) > 1 or not 1 <= len(set(names)) == len(names) <= _MOST_CLASSES:
        found = listed(wrong) or f"{len(names)} classes, {len(set(names))} different names"
        raise DataError(path, found=found, expected=_EXPECTED)
    if is_list:
        others = [value for value, name in enumerate(content) if name is None]
        labels = {**dict.fromkeys([*others, 255, _MOST_VALUE], 0), **labels}
    return LabelMap(names, labels, refuses_others=is_list)


def plain_name(name: str) -> str:
    """Return the first synonym of a name in the form in which names are compared.

    Case is ignored, and hyphens and underscores are spaces.

    >>> plain_name("Window-Pane, window")
    'window pane'
    >>> plain_name("STRASSE") == plain_name("Straße")
    True
    """
    first = composed(name).partition(",")[0].replace("-", " ").replace("_", " ")
    return " ".join(first.casefold().split())


def class_weights(counts: NDArray[np.int64], kind: ClassWeights) -> NDArray[np.float32]:
    """Return the weights of the classes in the loss.

    With r the share of a class among the labeled pixels: `log` is ``1 / ln(1.02 + r)``
    (released code of the paper), `sqrt` is ``1 / √r``, scaled to a mean of 1; `none` is 1.

    Args:
        counts: ``(K,)`` number of pixels of every class.
        kind: Kind of weighting.

    Returns:
        ``(K,)`` float32; 0 for classes without pixels, except with `none`.
    """
    if kind == "none":
        return np.ones(len(counts), np.float32)
    seen = counts > 0
    shares = counts[seen] / counts.sum()
    of_seen = 1 / (np.log(_LOG_OFFSET + shares) if kind == "log" else np.sqrt(shares))
    if kind == "sqrt" and len(of_seen):
        of_seen /= of_seen.mean()
    weights = np.zeros(len(counts), np.float32)
    weights[seen] = of_seen
    return weights


def label_doubts(split: str, counts: NDArray[np.int64], class_names: Sequence[str]) -> list[str]:
    """Return warnings about labels that may belong to other classes.

    Args:
        split: Name of the split.
        counts: ``(K+1,)`` number of pixels of every label, at least one above 0.
        class_names: ``(K+1,)`` names; the first is the name of unknown pixels.
    """
    doubts = []
    unknown = counts[0] / counts.sum()
    if unknown > _MOST_UNKNOWN:
        doubts.append(f"{100 * unknown:.1f} % of the pixels for {split} are unknown.")
    missing = [name for name, count in zip(class_names[1:], counts[1:], strict=True) if not count]
    if missing:
        doubts.append(
            f"Classes without a pixel for {split}: {listed(missing)} "
            f"({len(missing)} of {len(class_names) - 1})."
        )
    return doubts
