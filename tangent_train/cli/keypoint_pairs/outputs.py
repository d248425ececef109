"""What a pair leaves besides its figures: pictures, and parts of files for COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2

from tangent_train.errors import SettingError
from tangent_train.files import write_bytes
from tangent_train.results.keypoints.entries import AS_GIVEN, TURNED
from tangent_train.results.keypoints.pictures import DrawnMatches, matches_picture
from tangent_train.results.keypoints.tables import shown_name

if TYPE_CHECKING:
    from collections.abc import Container, Sequence
    from pathlib import Path

    from datamodules.core.panorama_pairs import PanoramaPair
    from tangent_train.cli.keypoint_pairs.export import ColmapExport
    from tangent_train.cli.keypoint_pairs.folder import ResultsFolder
    from tangent_train.results.keypoints.compare import Comparison
    from tangent_train.results.keypoints.found import Found

__all__ = ["PairOutputs"]


@dataclass(frozen=True)
class PairOutputs:
    """Draws the first pairs, and exports all.

    Attributes:
        folder: Where to.
        pictures: How many pairs to draw.
        turned: Whether there is a turned condition.
        export: For COLMAP; or None.
    """

    folder: ResultsFolder
    pictures: int
    turned: bool
    export: ColmapExport | None

    def missing(self, names: Sequence[str], done: Container[str]) -> list[int]:
        """Pairs of which something is not there yet.

        Args:
            names: Of all pairs.
            done: Names of those whose figures are there.
        """
        export = self.export if self.export and not self.export.is_complete(names) else None
        return [
            k
            for k, name in enumerate(names)
            if name not in done
            or not all(path.is_file() for path in self._pictures(k, name).values())
            or (export is not None and not export.has(name))
        ]

    def write(self, index: int, pair: PanoramaPair, comparison: Comparison) -> None:
        """Write what is wanted of a pair.

        Args:
            index: Of the pair.
            pair: The pair.
            comparison: What was found.

        Raises:
            SettingError: It cannot be written.
            DataError: The size of a panorama's file cannot be read.
        """
        try:
            if self.export is not None:
                self.export.add(pair, comparison)
            for condition, path in self._pictures(index, comparison.entry.name).items():
                write_bytes(path, _picture(comparison, condition))
        except OSError as error:
            raise SettingError(
                "output", found=error, expected="a folder that can be written, with room"
            ) from error

    def _pictures(self, index: int, name: str) -> dict[str, Path]:
        if index >= self.pictures:
            return {}
        conditions = (AS_GIVEN, TURNED) if self.turned else (AS_GIVEN,)
        return {c: self.folder.picture(index, name, c) for c in conditions}


def _picture(comparison: Comparison, condition: str) -> bytes:
    left, right = comparison.images[condition]
    drawn = {
        shown_name(name): _drawn(found, left.shape[:2], right.shape[:2])
        for name, found in comparison.found[condition].items()
    }
    picture = matches_picture(left, right, drawn)
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()


def _drawn(found: Found, left_shape: tuple[int, int], right_shape: tuple[int, int]) -> DrawnMatches:
    return DrawnMatches(
        found.left.equirect_pixels(left_shape)[found.matches[:, 0]],
        found.right.equirect_pixels(right_shape)[found.matches[:, 1]],
        found.geometry.inliers,
    )
