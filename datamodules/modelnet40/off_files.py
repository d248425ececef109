"""Meshes in OFF files (Object File Format), as ModelNet40's.

A file is a header with ``OFF``, a line with the numbers of vertices, faces and edges, then one line
for every vertex and every face::

    OFF
    8 6 0
    -0.5 -0.5 -0.5
    …
    4  0 1 2 3        number of corners, then their vertices; what follows is a colour, not read

Many files of ModelNet40 have header and numbers glued together (``OFF3514 3546 0``). Comments
(``#``), blank lines and further spaces are skipped. ``COFF``, ``NOFF`` and ``STOFF`` have more
numbers behind the coordinates of a vertex, which are not read.

Why not trimesh's reader: it takes files that are cut off and coordinates that are no numbers, and
does not say in which line something is wrong. NumPy's parser is also several times as fast.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tangent_train.errors import DataError
from tangent_train.files import write_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    # What is wrong with the words of a line: what was found and what was expected; or nothing.
    Check = Callable[[Sequence[str]], tuple[str, str] | None]

__all__ = ["Mesh", "read_off", "write_off"]

_HEADER = re.compile(r"(?:ST)?C?N?(?P<dimension>4?n?)OFF\s*(?P<counts>.*)")
_COUNT = re.compile(r"[0-9]{1,15}", re.ASCII)
_SHOWN = 40  # characters of a word in a message


class Mesh(NamedTuple):
    """Triangles.

    Attributes:
        vertices: ``(V, 3)`` float64 coordinates x, y, z.
        triangles: ``(F, 3)`` int64 vertices of each.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]


class _Lines(NamedTuple):
    """The lines of a file that say something.

    Attributes:
        path: The file.
        texts: The lines, without comments.
        numbers: Where they are in the file, from 1.
    """

    path: Path
    texts: list[str]
    numbers: list[int]

    def wrong(self, place: int, found: str, expected: str) -> DataError:
        """The error about the line at a place in `texts`."""
        return _wrong(self.path, self.numbers[place], found, expected)

    def table(self, places: Sequence[int], columns: range, kind: type, check: Check) -> Any:
        """Words of some lines, the same of each, as numbers ``(lines, columns)``.

        Raises:
            DataError: Some are missing or no such numbers.
        """
        texts = [self.texts[place] for place in places]
        try:
            return np.loadtxt(texts, kind, comments=None, usecols=columns, ndmin=2)
        except ValueError as error:
            raise self.first_wrong(places, check) from error

    def first_wrong(self, places: Sequence[int], check: Check) -> DataError:
        """The error about the first of some lines that is wrong."""
        for place in places:
            complaint = check(self.texts[place].split())
            if complaint is not None:
                return self.wrong(place, *complaint)
        return self.wrong(places[0], "something that cannot be read", "numbers")


def read_off(path: Path) -> Mesh:
    """Read a mesh; polygons become triangles around their first corner.

    Faces of fewer than three corners are left out.

    Args:
        path: The file.

    Raises:
        DataError: It is no such file, is cut off or has no triangles; or a line is wrong, which the
            error names.
    """
    lines = _read_lines(path)
    begin, count, faces = _read_header(lines)
    vertices = lines.table(range(begin, begin + count), range(3), float, _check_vertex)
    if not np.isfinite(vertices).all():
        raise lines.first_wrong(range(begin, begin + count), _check_vertex)
    triangles = _read_triangles(lines, range(begin + count, begin + count + faces), count)
    if not len(triangles):
        raise DataError(path, found="no face of three corners", expected="a mesh")
    return Mesh(vertices, triangles)


def write_off(path: Path, mesh: Mesh) -> None:
    """Write a mesh, whole or not at all; coordinates with seven digits.

    Args:
        path: The file.
        mesh: Its triangles.
    """
    vertices, triangles = mesh
    points = ("%.7g %.7g %.7g\n" * len(vertices)) % tuple(vertices.ravel().tolist())
    faces = ("3 %d %d %d\n" * len(triangles)) % tuple(triangles.ravel().tolist())
    write_text(path, f"OFF\n{len(vertices)} {len(triangles)} 0\n{points}{faces}")


def _read_lines(path: Path) -> _Lines:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(path, found=f"nothing to read ({error})", expected="a mesh") from error
    if b"\0" in data:
        raise _wrong(path, 1, "binary content", "OFF as text")
    # Latin-1 takes every byte: comments may be in any encoding.
    text = data.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if "#" in text:
        lines = [line.partition("#")[0] for line in lines]
    numbers = [number for number, line in enumerate(lines, 1) if line and not line.isspace()]
    return _Lines(path, [lines[number - 1] for number in numbers], numbers)


def _read_header(lines: _Lines) -> tuple[int, int, int]:
    """Place of the first vertex, number of vertices, number of faces."""
    if not lines.texts:
        raise DataError(lines.path, found="an empty file", expected="a mesh")
    header = lines.texts[0].strip()
    match = _HEADER.fullmatch(header)
    if match is None or match["dimension"]:
        raise lines.wrong(0, _shown(header), "OFF (or COFF, NOFF, STOFF)")
    if match["counts"].startswith("BINARY"):
        raise lines.wrong(0, "binary OFF", "OFF as text")
    place = 0 if match["counts"] else 1
    counts = [match["counts"], *lines.texts[1:2]][place:]
    if not counts:
        raise lines.wrong(0, "nothing more", "the numbers of vertices and faces")
    words = counts[0].split()
    if len(words) not in (2, 3) or not all(map(_COUNT.fullmatch, words[:2])):
        raise lines.wrong(place, _shown(counts[0].strip()), "the numbers of vertices and faces")
    vertices, faces = map(int, words[:2])
    follow = len(lines.texts) - place - 1
    if follow != vertices + faces:
        # Before anything is made of this size.
        raise lines.wrong(place, f"{vertices} vertices and {faces} faces", f"{follow}, as follow")
    if not vertices or not faces:
        raise lines.wrong(place, f"{vertices} vertices and {faces} faces", "some of each")
    return place + 1, vertices, faces


def _read_triangles(lines: _Lines, places: range, vertices: int) -> NDArray[np.int64]:
    """Triangles of the faces, in their order."""

    def check(words: Sequence[str]) -> tuple[str, str] | None:
        return _check_face(words, vertices)

    by_corners: dict[str, list[int]] = {}
    for place in places:
        by_corners.setdefault(lines.texts[place].split(None, 1)[0], []).append(place)
    triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for word, chosen in by_corners.items():
        longest = max(len(lines.texts[place]) for place in chosen)
        if not _COUNT.fullmatch(word) or 2 * int(word) >= longest:
            raise lines.first_wrong(chosen, check)
        corners = lines.table(chosen, range(1, int(word) + 1), int, check) if int(word) else None
        if corners is None or corners.shape[1] < 3:
            continue
        if corners.min() < 0 or corners.max() >= vertices:
            raise lines.first_wrong(chosen, check)
        first = np.broadcast_to(corners[:, :1], (len(chosen), int(word) - 2))
        fan = np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=-1)
        triangles.append(fan.reshape(-1, 3))
        owners.append(np.repeat(chosen, fan.shape[1]))
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(triangles)[order]


def _check_vertex(words: Sequence[str]) -> tuple[str, str] | None:
    expected = "three coordinates"
    if len(words) < 3:
        return _shown(" ".join(words)), expected
    for word in words[:3]:
        try:
            usable = math.isfinite(float(word)) and "_" not in word
        except ValueError:
            usable = False
        if not usable:
            return _shown(word), expected
    return None


def _check_face(words: Sequence[str], vertices: int) -> tuple[str, str] | None:
    if not _COUNT.fullmatch(words[0]):
        return _shown(words[0]), "the number of corners of a face"
    corners = words[1 : int(words[0]) + 1]
    if len(corners) < int(words[0]):
        return f"{len(corners)} vertices", f"{words[0]}, the corners of the face"
    for word in corners:
        if not _COUNT.fullmatch(word) or int(word) >= vertices:
            return f"vertex {_shown(word)}", f"0 to {vertices - 1}"
    return None


def _wrong(path: Path, number: int, found: str, expected: str) -> DataError:
    return DataError(f"{path}, line {number}", found=found, expected=expected)


def _shown(text: str) -> str:
    return ascii(text if len(text) <= _SHOWN else text[:_SHOWN] + "…")
