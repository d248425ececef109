"""Keypoints and matches of all pairs for COLMAP.

COLMAP's files are of all panoramas together, so that the parts are kept on disk, pair by pair,
until everything is there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.images.pixel_files import read_image_size
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, write_text
from tangent_train.json_text import parse_json
from tangent_train.keypoints.colmap import (
    ColmapImage,
    ColmapPair,
    write_colmap_database,
    write_colmap_text,
)
from tangent_train.keypoints.spherical import SphericalKeypoints
from tangent_train.keypoints.two_view import TwoView
from tangent_train.results.keypoints.entries import AS_GIVEN

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair
    from tangent_train.results.keypoints.compare import Comparison

__all__ = ["ColmapExport"]

_PARTS = ".parts"
_INDEX = "export.json"
_DATABASE = "database.db"


@dataclass(frozen=True)
class ColmapExport:
    """Export of the panoramas as they are; a folder for each representation.

    Attributes:
        folder: Where to.
        kind: ``colmap_text`` or ``colmap_database``.
        representations: See `Representations.names`.
    """

    folder: Path
    kind: str
    representations: tuple[str, ...]

    def check_files(self, files: Iterable[Path]) -> None:
        """Make sure, before any work, that COLMAP's files can hold the names.

        Args:
            files: Of all panoramas.

        Raises:
            SettingError: A name has a space, and COLMAP's lists of matches are wanted.
        """
        absolute = [file.absolute() for file in files]
        if self.kind != "colmap_text":
            return
        for file in absolute:
            name = file.relative_to(_root(absolute)).as_posix()
            if any(character.isspace() for character in name):
                raise SettingError(
                    "export",
                    found=f"colmap_text of {name!r}",
                    expected="names without spaces, which COLMAP's lists of matches cannot hold",
                    remedy="Choose export=colmap_database, which takes any name, or rename the "
                    "file.",
                )

    def is_complete(self, names: Sequence[str]) -> bool:
        """Whether all pairs are exported already, by name."""
        try:
            index = parse_json((self.folder / _INDEX).read_bytes())
            return index["kind"] == self.kind and set(names) <= set(index["pairs"])
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def has(self, name: str) -> bool:
        """Whether the parts of a pair are there."""
        return all(self._part(r, "pair", name).is_file() for r in self.representations)

    def add(self, pair: PanoramaPair, comparison: Comparison) -> None:
        """Write the parts of a pair.

        Args:
            pair: The pair.
            comparison: What was found.

        Raises:
            DataError: The size of a panorama's file cannot be read.
        """
        for representation, found in comparison.found[AS_GIVEN].items():
            for side, keypoints in ((pair.left, found.left), (pair.right, found.right)):
                path = self._part(representation, "panorama", side.name)
                if not path.is_file():
                    _save(path, **_of_keypoints(keypoints), **_of_file(side))
            geometry = found.geometry
            motion = {
                name: value
                for name in ("rotation", "translation")
                if (value := getattr(geometry, name)) is not None
            }
            _save(
                self._part(representation, "pair", pair.name),
                sides=np.array([pair.left.name, pair.right.name]),
                matches=found.matches,
                kind=np.array(geometry.kind),
                inliers=geometry.inliers,
                errors_deg=geometry.errors_deg,
                **motion,
            )

    def finish(self, names: Sequence[str]) -> Path:
        """Write COLMAP's files from the parts, and remove those.

        Args:
            names: Of the pairs.

        Returns:
            The folder that the names of the images are relative to.

        Raises:
            SettingError: COLMAP's files cannot hold them.
        """
        root = Path()
        for representation in self.representations:
            root = self._assemble(representation, names)
        index = {"kind": self.kind, "image_path": str(root), "pairs": list(names)}
        write_text(self.folder / _INDEX, json.dumps(index, indent=1, ensure_ascii=False) + "\n")
        shutil.rmtree(self.folder / _PARTS)
        return root

    def _assemble(self, representation: str, names: Sequence[str]) -> Path:
        pairs = {name: _load(self._part(representation, "pair", name)) for name in names}
        sides = dict.fromkeys(str(side) for part in pairs.values() for side in part["sides"])
        parts = {side: _load(self._part(representation, "panorama", side)) for side in sides}
        files = {side: Path(str(part["image_file"])) for side, part in parts.items()}
        root = _root(files.values())
        images = {side: _image(parts[side], files[side].relative_to(root)) for side in sides}
        matched = [_pair(part, images) for part in pairs.values()]
        folder = self.folder / representation
        if self.kind == "colmap_text":
            write_colmap_text(folder, list(images.values()), matched, overwrite=True)
        else:
            write_colmap_database(
                folder / _DATABASE, list(images.values()), matched, overwrite=True
            )
        return root

    def _part(self, representation: str, kind: str, name: str) -> Path:
        digest = hashlib.sha256(name.encode(errors="surrogateescape")).hexdigest()[:24]
        return self.folder / _PARTS / representation / f"{kind}_{digest}.npz"


def _root(files: Iterable[Path]) -> Path:
    """The folder that holds all of them, directly or in its folders."""
    return Path(os.path.commonpath([file.parent for file in files]))


def _of_keypoints(keypoints: SphericalKeypoints) -> dict[str, Any]:
    arrays = {f.name: getattr(keypoints, f.name) for f in fields(keypoints)}
    if keypoints.descriptors.dtype == np.float32:  # SIFT's are whole numbers up to 255
        arrays["descriptors"] = keypoints.descriptors.astype(np.uint8)
    return arrays


def _of_file(panorama: PairedPanorama) -> dict[str, Any]:
    """Where COLMAP will read it, and its size there.

    Raises:
        DataError: It is no file of a whole panorama.
    """
    if panorama.file is None:
        raise DataError(panorama.name, found="no file", expected="one, to export it")
    size = read_image_size(panorama.file)
    if abs(size[1] - 2 * size[0]) > 1:
        raise DataError(
            panorama.file,
            found=f"{size[0]}×{size[1]} pixels, a part of a panorama",
            expected="a whole one: COLMAP knows no others",
        )
    return {"image_file": np.array(str(panorama.file.absolute())), "size": np.array(size)}


def _image(part: dict[str, Any], name: Path) -> ColmapImage:
    keypoints = SphericalKeypoints(**{f.name: part[f.name] for f in fields(SphericalKeypoints)})
    height, width = part["size"].tolist()
    return ColmapImage(name.as_posix(), (height, width), keypoints)


def _pair(part: dict[str, Any], images: dict[str, ColmapImage]) -> ColmapPair:
    left, right = (images[str(side)].name for side in part["sides"])
    two_view = TwoView(
        str(part["kind"]),  # type: ignore[arg-type]
        part["inliers"],
        part["errors_deg"],
        part.get("rotation"),
        part.get("translation"),
    )
    return ColmapPair(left, right, part["matches"], two_view)


def _save(path: Path, **arrays: Any) -> None:
    with atomic_path(path) as temporary:
        np.savez(temporary, **arrays)


def _load(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)
