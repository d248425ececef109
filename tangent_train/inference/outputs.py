"""The files that a prediction leaves, and that none of the user's is among them."""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from tangent_train.errors import SettingError
from tangent_train.files import atomic_path, reserve, write_bytes, write_text
from tangent_train.results.pictures import colorize, overlay_picture

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from tangent_train.inference.labellers import Labelled
    from tangent_train.rendering.mosaic import ScoreMosaic

__all__ = ["OutputFolder", "output_names"]

_ROWS_AT_ONCE = 64
_OF_ALL = ("classes.json", "summary.json", "summary.csv", "report.html")


def output_names(paths: Sequence[Path]) -> list[str]:
    """A name for every image: its path below the folder all are in, without suffix.

    Images that would share a name keep their suffix.

    >>> output_names([Path("a/x/1.jpg"), Path("a/1.jpg"), Path("a/1.png")])
    ['x/1', '1.jpg', '1.png']
    """
    # Without "..", which would lead out of the output folder.
    absolute = [Path(os.path.abspath(path)) for path in paths]  # noqa: PTH100
    shared = 0
    for parts in zip(*(path.parent.parts for path in absolute), strict=False):
        if len(set(parts)) > 1:
            break
        shared += 1
    whole = [Path(*path.parts[shared:]) for path in absolute]
    short = [path.with_suffix("") for path in whole]
    # Upper and lower case are the same file on some disks; "1.jpg.png" without suffix is "1.jpg".
    taken = Counter(str(path).casefold() for path in (*short, *whole))
    chosen = zip(whole, short, strict=True)
    return [(a if taken[str(b).casefold()] > 1 else b).as_posix() for a, b in chosen]


@dataclass(frozen=True)
class OutputFolder:
    """Where results go.

    Attributes:
        path: The folder.
        class_names: K + 1 names, the unknown class first.
        probabilities: Whether they are written too.
    """

    path: Path
    class_names: Sequence[str]
    probabilities: bool = False

    def files(self, name: str) -> dict[str, Path]:
        """The files of one image, by kind."""
        kinds = {"labels": ".png", "color": ".png", "overlay": ".png"}
        kinds |= {"probabilities": ".npy"} if self.probabilities else {}
        return {kind: self.path / kind / f"{name}{suffix}" for kind, suffix in kinds.items()}

    def check(self, names: Iterable[str], *, overwrite: bool) -> None:
        """Make sure that nothing of the user's would be lost, before any work.

        Args:
            names: From `output_names`.
            overwrite: Whether earlier results may be.

        Raises:
            SettingError: A file is there already, or no folder can be.
        """
        place = next(p for p in (self.path, *self.path.absolute().parents) if p.exists())
        if not place.is_dir() or not os.access(place, os.W_OK):
            found = f"the file {place}" if place.is_file() else str(place)
            raise SettingError("output", found=found, expected="a folder that can be written")
        wanted = [file for name in names for file in self.files(name).values()]
        wanted += [self.path / name for name in _OF_ALL]
        there = [file for file in wanted if file.exists()]
        if there and not overwrite:
            raise SettingError(
                "output",
                found=f"{there[0]}" + (f" and {len(there) - 1} more" if there[1:] else ""),
                expected="a folder without earlier results",
                remedy="Give another folder, resume=true to keep them, or overwrite=true.",
            )

    def write_classes(self) -> None:
        """Write ``classes.json``: label values by name, as `datamodules.FolderPanoramas` reads."""
        values = {name: value for value, name in enumerate(self.class_names) if value}
        write_text(self.path / "classes.json", json.dumps(values, indent=1) + "\n")

    def write(self, name: str, found: Labelled) -> None:
        """Write labels, coloured labels and overlay of one image, and probabilities if wanted.

        Args:
            name: From `output_names`.
            found: The image and its labels.

        Raises:
            SettingError: They cannot be written.
        """
        try:
            self._write(name, found)
        except OSError as error:
            raise SettingError(
                "output", found=error, expected="a folder that can be written, with room"
            ) from error

    def _write(self, name: str, found: Labelled) -> None:
        files = self.files(name)
        _write_png(files["labels"], found.labels)
        _write_png(files["color"], colorize(found.labels, len(self.class_names)))
        _write_png(files["overlay"], overlay_picture(found.rgb, found.labels, self.class_names))
        if found.mosaic is not None:
            self._write_probabilities(files["probabilities"], found, found.mosaic)

    def _write_probabilities(self, path: Path, found: Labelled, mosaic: ScoreMosaic) -> None:
        """Write ``(h, w, K)`` float16 probabilities, class k being label k + 1."""
        with atomic_path(path) as temporary:
            shape = (*found.labels.shape, len(self.class_names) - 1)
            whole = tuple(map(np.arange, found.labels.shape))
            rows, columns = whole if found.area is None else found.area.places()
            array = np.lib.format.open_memmap(temporary, "w+", np.float16, shape)
            with temporary.open("r+b") as file:
                reserve(file, temporary.stat().st_size)
            for start in range(0, len(rows), _ROWS_AT_ONCE):
                part = slice(start, start + _ROWS_AT_ONCE)
                array[part] = mosaic.probabilities(rows[part])[:, columns]
            array.flush()


def _write_png(path: Path, image: NDArray[np.unsignedinteger]) -> None:
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    write_bytes(path, cv2.imencode(".png", image)[1].tobytes())
