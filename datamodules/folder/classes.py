"""Classes of a user-defined data set, `classes.json`: the meaning of its label pixels."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, counted
from tangent_train.files import is_class_name, read_json
from tangent_train.io.image_files import composed

UNKNOWN_NAME = "unknown"
"""Name of label 0, pixels without a class."""

_MOST_CLASSES = 255  # labels are uint8, and 0 is unknown
_MOST_VALUE = 65535
_UNKNOWN_VALUES = (255, 65535)
_MOST_SHOWN = 8
_COLOR = re.compile(r"#[0-9a-fA-F]{6}")
_EXPECTED = (
    'a list of class names, ["wall", "floor"], or an object with the values or colors of each '
    'class, {"wall": 1, "floor": [2, 3]} or {"wall": "#ff0000"}'
)


@dataclass(frozen=True, eq=False)
class FolderClasses:
    """Mapping from values or colors of label images to classes.

    Attributes:
        names: K names; the label of a class is its index plus one.
        codes: ``(n,)`` int32, ascending: values, or colors as R · 65536 + G · 256 + B.
        labels: ``(n,)`` uint8 label of each code.
        in_colors: True if the codes are colors.
        length: Length of the list of names; None if the classes have values or colors.
    """

    names: tuple[str, ...]
    codes: NDArray[np.int32]
    labels: NDArray[np.uint8]
    in_colors: bool
    length: int | None = None

    @property
    def fingerprint(self) -> str:
        """Text that changes when the labels of pixels may change."""
        parts = [self.codes.tobytes(), self.labels.tobytes(), bytes([self.in_colors])]
        return hashlib.sha256(b"".join(parts)).hexdigest()[:16]

    def decode(self, stored: NDArray[np.integer], path: object = "labels") -> NDArray[np.uint8]:
        """Return the labels of a label image, 0 for pixels without a class.

        Args:
            stored: ``(H, W)`` values, or ``(H, W, 3)`` uint8 colors.
            path: File of the label image, for error messages.

        Returns:
            ``(H, W)``.

        Raises:
            DataError: A value is past the end of the list of classes, and is not a value for
                unknown pixels (255, and 65535 with 16 bits).

        >>> codes, labels = np.array([7], np.int32), np.array([1], np.uint8)
        >>> classes = FolderClasses(("wall",), codes, labels, in_colors=False)
        >>> classes.decode(np.array([[6, 7, 8]])).tolist()
        [[0, 1, 0]]
        """
        if self.length is not None:
            past = stored[(stored >= self.length) & ~np.isin(stored, _UNKNOWN_VALUES)]
            if past.size:
                raise DataError(
                    path,
                    found=f"value {past.min()} in {counted(past.size, 'pixels')}",
                    expected=f"0 to {self.length - 1}, the places in the list of classes.json, or "
                    f"{_UNKNOWN_VALUES[0]}",
                    remedy="Add the class to the list, or null for a value without a class.",
                )
        codes = self.pack(stored)
        place = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        return np.where(self.codes[place] == codes, self.labels[place], np.uint8(0))

    def pack(self, stored: NDArray[np.integer]) -> NDArray[np.int32]:
        """Return the code of each pixel of a label image, as in `codes`."""
        numbers = stored.astype(np.int32)
        if not self.in_colors:
            return numbers
        return numbers[..., 0] << 16 | numbers[..., 1] << 8 | numbers[..., 2]

    def describe(self, codes: NDArray[np.int32]) -> str:
        """Format codes as in `classes.json`."""
        written = "#{:06x}" if self.in_colors else "{}"
        shown = [written.format(code) for code in codes[:_MOST_SHOWN].tolist()]
        shown += ["…"] if len(codes) > _MOST_SHOWN else []
        return ("colors " if self.in_colors else "values ") + ", ".join(shown)


NO_CLASSES = FolderClasses((), np.empty(0, np.int32), np.empty(0, np.uint8), in_colors=False)
"""Classes of folders whose labels are distances."""


def read_classes(path: Path) -> FolderClasses:
    """Read `classes.json`, in one of these forms.

    * A list of names: the value of a class is its index in the list, from 0. ``null`` instead of a
      name leaves a value without a class::

          [null, "wall", "floor"]

    * An object of names and values, 0 to 65535, or several values for one class::

          {"wall": 1, "floor": [2, 3], "window": 255}

    * An object of names and colors, one or several::

          {"wall": "#ff0000", "floor": ["#00ff00", "#00ee00"]}

    Other colors, and values that an object does not name, are unknown: such pixels are ignored in
    training and evaluation. With a list, only 255 (and 65535 of 16 bits) are unknown; other values
    past its end are errors. "unknown" is therefore not a class.

    Args:
        path: File to read.

    Raises:
        DataError: The file cannot be read, has another form, repeats a value, or has no classes.
    """
    if not path.exists():
        raise DataError(
            path,
            found="no such file" if path.parent.is_dir() else f"no folder {path.parent}",
            expected="the classes of your images",
            remedy="Give data.root=<folder>; docs/how-to/own_data.md describes its files.",
        )
    guide = "docs/how-to/own_data.md shows how to bring your own data."
    content = read_json(path, _EXPECTED, guide)
    if isinstance(content, list):
        named = [(name, [place]) for place, name in enumerate(content) if name is not None]
    elif isinstance(content, dict):
        named = [(n, given if isinstance(given, list) else [given]) for n, given in content.items()]
    else:
        raise DataError(path, found=json.dumps(content), expected=_EXPECTED)
    named = [(composed(n) if isinstance(n, str) else n, given) for n, given in named]
    _check_names(path, [name for name, _ in named])
    codes = _codes(path, named)
    ordered = sorted(codes)
    return FolderClasses(
        names=tuple(name for name, _ in named),
        codes=np.array(ordered, np.int32),
        labels=np.array([codes[code] for code in ordered], np.uint8),
        in_colors=isinstance(named[0][1][0], str),
        length=len(content) if isinstance(content, list) else None,
    )


def _check_names(path: Path, names: list[Any]) -> None:
    if not 1 <= len(names) <= _MOST_CLASSES:
        raise DataError(
            path, found=f"{len(names)} classes", expected=f"1 to {_MOST_CLASSES} classes"
        )
    strange = [name for name in names if not is_class_name(name) or not name.strip()]
    if strange:
        remedy = "A name is a line of text, without control characters."
        found = f"class name {strange[0]!r}"
        raise DataError(path, found=found, expected=_EXPECTED, remedy=remedy)
    if UNKNOWN_NAME in names:
        raise DataError(
            path,
            found=f"a class {UNKNOWN_NAME!r}",
            expected="none: everything not named is unknown",
            remedy="Leave it out; in a list, write null in its place.",
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(
            path,
            found=f"class {twice[0]!r} twice",
            expected="every name once",
            remedy='For several values or colors, write {"floor": [2, 3]}.',
        )


def _codes(path: Path, named: list[tuple[str, list[Any]]]) -> dict[int, int]:
    """Return the label of every value or color."""
    if len({isinstance(value, str) for _, values in named for value in values}) > 1:
        raise DataError(path, found="values and colors", expected="either values or colors")
    labels: dict[int, int] = {}
    for label, (name, values) in enumerate(named, start=1):
        if not values:
            raise DataError(path, found=f"nothing for {name!r}", expected="a value or a color")
        for value in values:
            other = named[labels.setdefault(_code(path, name, value), label) - 1][0]
            if other != name:
                found = f"{value} for {other!r} and {name!r}"
                raise DataError(path, found=found, expected="every value or color once")
    return labels


def _code(path: Path, name: str, value: Any) -> int:
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MOST_VALUE:
        return value
    if isinstance(value, str) and _COLOR.fullmatch(value):
        return int(value[1:], 16)
    raise DataError(
        path,
        found=f"{json.dumps(value)} for {name!r}",
        expected=f'a value of 0 to {_MOST_VALUE}, a color such as "#ff8000", or a list of either',
    )
