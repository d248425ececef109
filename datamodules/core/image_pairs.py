"""Pairs of one's own panoramas."""

from __future__ import annotations

import glob
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair, PanoramaPairs
from datamodules.images.gpano import area_of, whole_area
from datamodules.images.image_files import find_images
from datamodules.images.pixel_files import read_rgb
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from datamodules.images.gpano import PanoramaArea

__all__ = ["ImagePairs"]


class ImagePairs(PanoramaPairs):
    """Pairs of panoramas that are image files, without depth and pose.

    Args:
        left: One panorama; together with `right`.
        right: The other.
        input: Instead: a folder of panoramas, or a pattern, see `find_images`.
        pairing: Of `input`: `consecutive`, each with the next in the order of the paths; or `all`,
            each with each.

    Raises:
        SettingError: Settings do not fit together.
        DataError: There are no two panoramas.
    """

    def __init__(
        self,
        left: str | None = None,
        right: str | None = None,
        input: str | None = None,  # noqa: A002, the name of the setting
        pairing: Literal["consecutive", "all"] = "consecutive",
    ) -> None:
        two = left is not None and right is not None
        if two == (input is not None) or (input is not None and (left or right)):
            given = {"left": left, "right": right, "input": input}
            raise SettingError(
                "input",
                found=", ".join(f"{k}={v}" for k, v in given.items() if v is not None) or "none",
                expected="left=<panorama> right=<panorama>, or input=<folder of panoramas>",
            )
        if pairing not in ("consecutive", "all"):
            raise SettingError("pairing", found=pairing, expected="consecutive or all")
        if input is None:
            self._paths = [_one("left", str(left)), _one("right", str(right))]
        else:
            self._paths = find_images(input)
        if len(self._paths) < 2:
            raise DataError(input, found=f"only {self._paths[0]}", expected="two panoramas or more")
        self._names = _names(self._paths)
        indices = range(len(self._paths))
        self._pairs = list(
            pairwise(indices) if pairing == "consecutive" else combinations(indices, 2)
        )

    def __len__(self) -> int:
        """See `PanoramaPairs`."""
        return len(self._pairs)

    def name(self, index: int) -> str:
        """The names of both files."""
        left, right = self._pairs[index]
        return f"{self._names[left]} – {self._names[right]}"

    def files(self, index: int) -> tuple[Path, Path]:
        """Both files."""
        left, right = self._pairs[index]
        return self._paths[left], self._paths[right]

    def read(self, index: int) -> PanoramaPair:
        """Read a pair; of panoramas that are a part of the sphere the rest is black.

        Raises:
            DataError: A file cannot be used.
        """
        left, right = (_panorama(self._names[i], self._paths[i]) for i in self._pairs[index])
        return PanoramaPair(self.name(index), None, left, right)


def _one(side: str, pattern: str) -> Path:
    if not glob.has_magic(pattern) and not Path(pattern).expanduser().exists():
        raise SettingError(f"{side}: no such file: {pattern}")
    found = find_images(pattern)
    if len(found) > 1:
        raise SettingError(
            side,
            found=f"{len(found)} images ({pattern})",
            expected="one panorama",
            remedy="Name folders with input=.",
        )
    return found[0]


def _names(paths: list[Path]) -> list[str]:
    """Short names, unique: those of the files, or as much of their paths as tells them apart."""
    for named in ([path.with_suffix("") for path in paths], paths):
        for depth in range(1, max(len(path.parts) for path in paths) + 1):
            names = ["/".join(path.parts[-depth:]) for path in named]
            if len(set(names)) == len(set(paths)):
                return names
    return [str(path) for path in paths]


def _panorama(name: str, path: Path) -> PairedPanorama:
    rgb = read_rgb(path)
    size = (rgb.shape[0], rgb.shape[1])
    area = area_of(path, size) or _whole(path, size)
    return PairedPanorama(name, area.place(rgb), file=path)


def _whole(path: Path, size: tuple[int, int]) -> PanoramaArea:
    """All of the sphere; the message names only what pairs can be told."""
    try:
        return whole_area(path, size)
    except DataError as error:
        raise DataError(
            path,
            found=error.found,
            expected="a whole panorama, twice as wide as high, or a part with GPano tags that say "
            "where it lies",
        ) from None
