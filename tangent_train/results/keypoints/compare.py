"""Detecting, matching and scoring the keypoints of one pair of panoramas, in several ways."""

from __future__ import annotations

import time
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.geometry import nearest_level, random_rotation
from tangent_train.keypoints.matching import match
from tangent_train.keypoints.two_view import estimate_two_view
from tangent_train.rendering import rotate_equirect
from tangent_train.results.keypoints.entries import AS_GIVEN, TURNED, PairEntry, Scored
from tangent_train.results.keypoints.found import Found
from tangent_train.results.keypoints.representations import Representations, at_level
from tangent_train.results.keypoints.seen import Seen

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair
    from tangent_train.keypoints.spherical import SphericalKeypoints

__all__ = ["Comparer", "Comparison", "Matching"]

_PANORAMAS_KEPT = 4


@dataclass(frozen=True)
class Matching:
    """How keypoints are matched and geometry is estimated.

    Attributes:
        ratio: See `match`.
        mutual: See `match`.
        max_error_deg: See `estimate_two_view`.
        seed: Of random samples and of the random rotations.
    """

    ratio: float = 0.8
    mutual: bool = True
    max_error_deg: float = 1.0
    seed: int = 0

    def turn(self, name: str) -> NDArray[np.float64]:
        """The random rotation of the right panorama of a pair, the same in every run."""
        return random_rotation(np.random.default_rng([self.seed, zlib.crc32(name.encode())]))


class Comparison(NamedTuple):
    """What was found out about a pair.

    Attributes:
        entry: Figures.
        found: Keypoints and matches by condition and representation.
        images: The left and the right panorama of every condition, as keypoints were detected.
    """

    entry: PairEntry
    found: Mapping[str, Mapping[str, Found]]
    images: Mapping[str, tuple[NDArray[np.uint8], NDArray[np.uint8]]]


@dataclass
class Comparer:
    """Compares representations on pairs; remembers keypoints of the last panoramas.

    Attributes:
        representations: What keypoints are detected on.
        matching: How they are matched.
        level: Level s; None for the level nearest to the larger panorama.
        turned: Whether the right panorama is also turned by a random rotation.
    """

    representations: Representations
    matching: Matching
    level: int | None = None
    turned: bool = True
    _kept: OrderedDict[tuple[str, int], dict[str, SphericalKeypoints]] = field(
        default_factory=OrderedDict
    )

    def compare(self, pair: PanoramaPair) -> Comparison:
        """Compare all representations on one pair.

        Args:
            pair: The pair.

        Raises:
            SettingError: The panoramas are too small for the level or for a base level.
        """
        begun = time.monotonic()
        rows, level = self._rows_and_level(pair)
        turns = {AS_GIVEN: np.eye(3)}
        if self.turned:
            turns[TURNED] = self.matching.turn(pair.name)
        left, right = (at_level(side.rgb, level) for side in (pair.left, pair.right))
        images = {
            condition: (left, right if condition == AS_GIVEN else rotate_equirect(right, turn))
            for condition, turn in turns.items()
        }
        seen = Seen(pair, self.matching.max_error_deg)
        found: dict[str, dict[str, Found]] = {}
        scored: list[Scored] = []
        for condition, turn in turns.items():
            found[condition] = {}
            for name in self.representations.names:
                both = self._found(pair, images[condition], level, condition, name)
                found[condition][name] = both
                scored.append(seen.scored(both, turn, condition, name))
        entry = PairEntry(
            name=pair.name,
            split=pair.split,
            left=pair.left.name,
            right=pair.right.name,
            rows=rows,
            level=level,
            fov_overlap=seen.fov_overlap(),
            has_geometry=seen.has_geometry,
            scored=tuple(scored),
            seconds=round(time.monotonic() - begun, 2),
        )
        return Comparison(entry, found, images)

    def _rows_and_level(self, pair: PanoramaPair) -> tuple[int, int]:
        """Rows of the larger panorama, and the level to detect keypoints at.

        Raises:
            SettingError: The level is finer than the panorama, which would only be magnified, or
                too coarse for a base level.
        """
        larger = max(pair.left, pair.right, key=lambda side: side.rgb.shape[0])
        rows = larger.rgb.shape[0]
        own = nearest_level(rows)
        of_panorama = f"that of {larger.name}, {rows} rows"
        if self.level is not None and self.level > own:
            raise SettingError("level", found=self.level, expected=f"at most {own}, {of_panorama}")
        level = own if self.level is None else self.level
        reason = f"The level is {of_panorama}." if self.level is None else ""
        self.representations.check_level(level, reason)
        return rows, level

    def _found(
        self,
        pair: PanoramaPair,
        images: tuple[NDArray[np.uint8], NDArray[np.uint8]],
        level: int,
        condition: str,
        name: str,
    ) -> Found:
        left = self._detected(pair.left, images[0], level, name)
        if condition == AS_GIVEN:
            right = self._detected(pair.right, images[1], level, name)
        else:
            right = self.representations.detect(images[1], level, name)
        how = self.matching
        matches = match(
            left.descriptors,
            right.descriptors,
            self.representations.detector.norm,
            how.ratio,
            mutual=how.mutual,
        )
        geometry = estimate_two_view(
            left.directions_xyz[matches[:, 0]],
            right.directions_xyz[matches[:, 1]],
            how.max_error_deg,
            seed=how.seed,
        )
        return Found(left, right, matches, geometry)

    def _detected(
        self, panorama: PairedPanorama, image: NDArray[np.uint8], level: int, name: str
    ) -> SphericalKeypoints:
        """Keypoints of a panorama that may be in several pairs."""
        key = (panorama.name, level)
        kept = self._kept.setdefault(key, {})
        self._kept.move_to_end(key)
        while len(self._kept) > _PANORAMAS_KEPT:
            self._kept.popitem(last=False)
        if name not in kept:
            kept[name] = self.representations.detect(image, level, name)
        return kept[name]
