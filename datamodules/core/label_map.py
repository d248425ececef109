"""Label maps: the class of every value, color or name.

Label 0 is unknown, and the label of a class is its index plus one.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, counted
from tangent_train.files import read_json
from tangent_train.io.image_files import composed
from tangent_train.io.pixel_files import read_pixels, read_rgb

UNKNOWN_NAME = "unknown"
"""Name of label 0, pixels without a class."""

Key = int | str
"""A value 0 to 65535; a color ``#ff8000``; or the name of a class, see `plain_name`."""

_REFUSED = 255
_MOST_CLASSES = 254  # labels are uint8, and 0 is unknown
_MOST_VALUE = 65535
_UNKNOWN_VALUES = (255, 65535)
_COLOR = re.compile(r"#[0-9a-f]{6}")
_MOST_SHOWN = 8
_EXPECTED = (
    'a list of class names, ["wall", "floor"], or an object with the values, colors or names of '
    'each class, {"wall": 1, "floor": [2, 3]}, {"wall": "#ff0000"} or {"wall": ["painting"]}'
)


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
        *,
        refuses_others: bool = True,
    ) -> Self:
        """Return the map of some classes.

        Args:
            classes: Values, colors or names of each class; or the names of the classes, whose
                values are then 1 to K.
            unknown: Values of pixels without a class.
            refuses_others: See the class.

        >>> LabelMap.of({"car": [7, 8], "bus": 9}, [0]).decode(np.array([0, 7, 8, 9])).tolist()
        [0, 1, 1, 2]
        """
        if not isinstance(classes, Mapping):
            classes = {name: value for value, name in enumerate(classes, start=1)}
        labels = dict.fromkeys(unknown, 0)
        for label, given in enumerate(classes.values(), start=1):
            keys = [given] if isinstance(given, Key) else given
            labels |= dict.fromkeys(map(_plain_key, keys), label)
        return cls(tuple(classes), labels, refuses_others)

    @classmethod
    def grouped(cls, names: Sequence[str], groups: Mapping[str, str] | None = None) -> Self:
        """Return the map of class names to the classes of a benchmark, e.g. for `regrouped`.

        Args:
            names: Names of the benchmark's classes, which classes of the same name belong to.
            groups: Class of the benchmark by name of other classes. Further classes are unknown.
        """
        members = {name: [name] for name in names}
        for name, group in (groups or {}).items():
            if group in members and name not in members:
                members[group].append(name)
        return cls.of(members, refuses_others=False)

    def regrouped(self, groups: LabelMap) -> LabelMap:
        """Return the map from the same values to other classes, by the names of the classes."""
        of_labels = [0, *(groups.labels.get(plain_name(name), 0) for name in self.names)]
        labels = {key: of_labels[label] for key, label in self.labels.items()}
        return LabelMap(groups.names, labels, self.refuses_others)

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
        elif stored.dtype.itemsize > 2 or stored.dtype.kind != "u":
            codes = np.clip(stored, 0, _MOST_VALUE)
        labels = self._table[codes]
        if self.refuses_others and labels.max(initial=0) == _REFUSED:
            others, count = np.unique(stored[labels == _REFUSED]), (labels == _REFUSED).sum()
            known = [key for key in self.labels if isinstance(key, int)]
            raise DataError(
                path,
                found=f"{_shown(others.tolist())} in {counted(int(count), 'pixels')}",
                expected=_shown(sorted(known)),
                remedy="Name the values in the label map, e.g. classes.json, or take the files "
                "unconverted.",
            )
        return labels

    def read_labels(self, path: Path) -> NDArray[np.uint8]:
        """Return the labels ``(H, W)`` of a label image; the values of a palette are its indices.

        Raises:
            DataError: The file is broken, holds other values, or colors instead of values.
        """
        stored = read_rgb(path) if self.in_colors else read_pixels(path, indices=True)
        if stored.ndim == 3 and not self.in_colors:
            raise DataError(path, found="colors", expected="values of classes, one per pixel")
        return self.decode(stored, path)

    def describe(self) -> str:
        """Return the values or colors of the map in one line."""
        return ("colors " if self.in_colors else "values ") + _shown(list(self.labels))


def _shown(keys: Sequence[Any]) -> str:
    return ", ".join(map(str, keys[:_MOST_SHOWN])) + (", …" if len(keys) > _MOST_SHOWN else "")


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
    content = read_json(
        path, _EXPECTED, "docs/how-to/own_data.md shows how to bring your own data."
    )
    if isinstance(content, dict) and isinstance(content.get("classes"), dict):
        content = content["classes"]
    if isinstance(content, list):
        named = [(name, [value]) for value, name in enumerate(content) if name is not None]
    elif isinstance(content, dict):
        named = [(n, keys if isinstance(keys, list) else [keys]) for n, keys in content.items()]
    else:
        named = []
    labels: dict[Key, int] = {}
    for label, (name, keys) in enumerate(named, start=1):
        for key in keys:
            _check(path, name, key, labels)
            labels[_plain_key(key)] = label
    names = tuple(composed(name) for name, _ in named)
    kinds = {str if isinstance(key, str) and _COLOR.fullmatch(key) else type(key) for key in labels}
    if not 1 <= len(set(names)) == len(names) <= _MOST_CLASSES or len(kinds) > 1:
        found = f"{counted(len(names), 'classes')}, {counted(len(set(names)), 'different names')}"
        expected = f"{_EXPECTED}; 1 to {_MOST_CLASSES} classes with different names"
        raise DataError(path, found=found, expected=expected)
    if not isinstance(content, list):
        return LabelMap(names, labels, refuses_others=False)
    unknown: list[Key] = [*(v for v, name in enumerate(content) if name is None), *_UNKNOWN_VALUES]
    return LabelMap(names, dict.fromkeys(unknown, 0) | labels)


def _check(path: Path, name: Any, key: Any, labels: Mapping[Key, int]) -> None:
    """Refuse names and keys of other kinds, and repeated keys."""
    is_value = type(key) is int and 0 <= key <= _MOST_VALUE
    is_name = isinstance(name, str) and bool(name.strip()) and name.isprintable()
    found = f"{json.dumps(key)} for {json.dumps(name)}"
    if not is_name or name == UNKNOWN_NAME or not (is_value or isinstance(key, str)):
        raise DataError(path, found=found, expected=_EXPECTED)
    if _plain_key(key) in labels:
        raise DataError(path, found=f"{found}, twice", expected="every key once")


def _plain_key(key: Key) -> Key:
    return plain_name(key) if isinstance(key, str) else key


def plain_name(name: str) -> str:
    """Return the first synonym of a name in the form in which names are compared.

    Case is ignored, and hyphens and underscores are spaces.

    >>> plain_name("Window-Pane, window")
    'window pane'
    """
    first = composed(name).partition(",")[0].replace("-", " ").replace("_", " ")
    return " ".join(first.casefold().split())
