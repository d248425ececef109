"""Detect, match and score the keypoints of a pair on several representations."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.core.panorama_pairs import PanoramaPair
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PanoramaPose,
    TangentGrid,
    equirect_shape,
    nearest_level,
    random_rotation,
)
from tangent_train.geometry.coverage import is_valid
from tangent_train.geometry.sphere import Floats
from tangent_train.keypoints.covisibility import (
    DepthView,
    correct_matches,
    fov_overlap,
    visible_from,
)
from tangent_train.keypoints.features import (
    SphericalKeypoints,
    detect_on_equirect,
    detect_on_tangent_images,
    match,
)
from tangent_train.keypoints.two_view import TwoView, estimate_two_view
from tangent_train.rendering import rotate_equirect

Row = dict[str, Any]
"""Figures of one pair, condition and representation, see `Comparer.compare`."""

_Views = tuple[DepthView, DepthView]
"""Depth and pose of the left and of the right panorama."""

AS_GIVEN, ROTATED = "as_given", "rotated"
"""Conditions: both panoramas unchanged; the right panorama randomly rotated."""

SHRUNK = "ERP ×0.71"
"""The panorama with pixels as large as those of tangent images, see `shrunk_rows`."""

CUBE = "cube"
"""The six faces of a cube, 90° over as many pixels as on the panorama's equator."""

AUC_DEG = (5, 10, 20)
"""Upper limits of the pose error for the area under the recall curve."""

_TRUTH = (
    *("rotation_error_deg", "translation_error_deg", *(f"pose_auc_{d}" for d in AUC_DEG)),
    *("verifiable", "correct", "correct_share"),
)
"""Scores that need depth and pose."""


class MatchedPair(NamedTuple):
    """Keypoints of two panoramas, ``(m, 2)`` matches among them, and their geometry."""

    left: SphericalKeypoints
    right: SphericalKeypoints
    matches: NDArray[np.int64]
    geometry: TwoView


class Comparison(NamedTuple):
    """A compared pair.

    Attributes:
        rows: Scores by condition and representation.
        matched: Keypoints and matches by condition and representation.
        images: Left and right panorama in which keypoints were detected, by condition.
    """

    rows: list[Row]
    matched: dict[str, dict[str, MatchedPair]]
    images: dict[str, tuple[NDArray[np.uint8], NDArray[np.uint8]]]


@dataclass
class Comparer:
    """Compares representations on pairs.

    Attributes:
        base_level: Base levels of the tangent images.
        margin: Number of pixels added around every tangent image.
        level: Level s; None for the level nearest to the larger panorama, the largest.
        ratio: Largest ratio of descriptor distances, see `match`.
        mutual: True to keep mutual matches only, see `match`.
        max_error_deg: Largest error of an inlier, see `estimate_two_view`; at most 20.
        seed: Seed of random samples and random rotations.
        controls: True to compare the downsampled panorama, a cube and the rotated panorama too.
    """

    base_level: tuple[int, ...]
    margin: int = 32
    level: int | None = None
    ratio: float = 0.8
    mutual: bool = True
    max_error_deg: float = 1.0
    seed: int = 0
    controls: bool = True

    def __post_init__(self) -> None:
        self._cache: dict[tuple[str, int], dict[str, SphericalKeypoints]] = {}

    def compare(self, pair: PanoramaPair) -> Comparison:
        """Compare all representations on one pair.

        Args:
            pair: Pair of panoramas.

        Returns:
            Comparison whose rows have n_L and n_R as ``visible_left`` and ``visible_right`` (all
            keypoints if depth and pose are unknown), and PMR, MS and P as shares of 1. With depth
            and pose, they have the errors of the estimated motion, the area under the recall curve
            of the pair, and the number of ``correct`` matches among the ``verifiable`` ones.
            Undefined scores are None.

        Raises:
            SettingError: The level is above that of the panoramas.
        """
        sides = (pair.left, pair.right)
        level = nearest = nearest_level(max(side.rgb.shape[0] for side in sides))
        if self.level is not None and (level := self.level) > nearest:
            raise SettingError("level", found=level, expected=f"{nearest} or less for {pair.name}")
        images = [_shrunk(side.rgb, equirect_shape(level)[0]) for side in sides]
        # Keypoints of a panorama of the previous pair are used again.
        self._cache = {
            (side.name, level): self._cache.get((side.name, level))
            or self._detect(image, level, side.valid)
            for side, image in zip(sides, images, strict=True)
        }
        left, right = (self._cache[side.name, level] for side in sides)
        conditions = {AS_GIVEN: (np.eye(3), images[1], right)}
        if self.controls:
            rng = np.random.default_rng([self.seed, zlib.crc32(pair.name.encode())])
            rotation, valid = random_rotation(rng), pair.right.valid
            if valid is not None:
                valid = rotate_equirect(valid.astype(np.uint8), rotation, "nearest") > 0
            image = rotate_equirect(images[1], rotation)
            conditions[ROTATED] = rotation, image, self._detect(image, level, valid)
        views: Any = [
            DepthView(side.distance_m, side.pose)
            for side in sides
            if side.distance_m is not None and side.pose is not None
        ]
        has_depth = len(views) == 2
        common = {
            "pair": pair.name,
            "split": pair.split,
            "left": pair.left.name,
            "right": pair.right.name,
            "level": level,
            "fov_overlap": _defined(fov_overlap(*views)) if has_depth else None,
            "visible_by": "depth" if has_depth else "all keypoints",
        }
        comparison = Comparison([], {}, {})
        for condition, (rotation, image, right) in conditions.items():
            matched = {name: self._match(left[name], right[name]) for name in left}
            comparison.images[condition] = (images[0], image)
            comparison.matched[condition] = matched
            for name, found in matched.items():
                row = {**common, "condition": condition, "representation": name}
                row |= self._scores(found, rotation, views if has_depth else None)
                comparison.rows.append(row)
        return comparison

    def _detect(
        self, rgb: NDArray[np.uint8], level: int, valid: NDArray[np.bool_] | None
    ) -> dict[str, SphericalKeypoints]:
        """Return the keypoints at valid pixels by representation, in the order of the tables."""
        found = {"ERP": detect_on_equirect(rgb)}
        grids: dict[str, Any] = {f"L{b}": TangentGrid(b, level) for b in self.base_level}
        if self.controls:
            found[SHRUNK] = detect_on_equirect(_shrunk(rgb, shrunk_rows(level)))
            grids = {CUBE: CubeGrid(2**level), **grids}
        for name, grid in grids.items():
            found[name] = detect_on_tangent_images(rgb, grid, self.margin)
        if valid is None:
            return found
        return {name: k.select(is_valid(valid, k.directions_xyz)) for name, k in found.items()}

    def _match(self, left: SphericalKeypoints, right: SphericalKeypoints) -> MatchedPair:
        matches = match(left.descriptors, right.descriptors, self.ratio, mutual=self.mutual)
        rays = left.directions_xyz[matches[:, 0]], right.directions_xyz[matches[:, 1]]
        geometry = estimate_two_view(*rays, self.max_error_deg, seed=self.seed)
        return MatchedPair(left, right, matches, geometry)

    def _scores(self, pair: MatchedPair, rotation: Floats, views: _Views | None) -> Row:
        counts = {"left": len(pair.left), "right": len(pair.right)}
        row: Row = {f"keypoints_{side}": count for side, count in counts.items()}
        row |= {f"visible_{side}": count for side, count in counts.items()}
        row |= dict.fromkeys(("putative", "inliers", "pmr", "ms", "p", "geometry", *_TRUTH))
        if views is not None:
            row |= self._truth(pair, rotation, views)
        row["putative"] = putative = len(pair.matches)
        row["inliers"] = inliers = int(pair.geometry.inliers.sum())
        row["geometry"] = pair.geometry.kind
        visible = row["visible_left"], row["visible_right"]
        if all(visible):
            share = sum(1 / n for n in visible) / 2
            row |= {"pmr": putative * share, "ms": inliers * share}
        row["p"] = inliers / putative if putative else None
        return row

    def _truth(self, pair: MatchedPair, rotation: Floats, views: _Views) -> Row:
        """Return the numbers of visible keypoints, and the scores that need depth and pose."""
        (left, right), left_xyz = views, pair.left.directions_xyz
        # In the unrotated right panorama, whose depth needs no resampling.
        right_xyz = pair.right.directions_xyz @ rotation
        rays = left_xyz[pair.matches[:, 0]], right_xyz[pair.matches[:, 1]]
        is_correct, is_known = correct_matches(*rays, left, right, self.max_error_deg)
        correct, known = int(is_correct.sum()), int(is_known.sum())
        rotated = PanoramaPose(right.pose.world_from_panorama @ rotation.T, right.pose.location_m)
        errors = pair.geometry.pose_error_deg(left.pose, rotated)
        # The recall of one pair is a step from 0 to 1 at its error; without an estimate it stays 0.
        worst = max(errors) if all(map(math.isfinite, errors)) else math.inf
        moved = not np.array_equal(left.pose.location_m, right.pose.location_m)
        areas = (max(0.0, 1 - worst / limit) if moved else None for limit in AUC_DEG)
        share = correct / known if known else None
        scores = (*map(_defined, errors), *areas, known, correct, share)
        return dict(zip(_TRUTH, scores, strict=True)) | {
            "visible_left": int(visible_from(left_xyz, left, right).sum()),
            "visible_right": int(visible_from(right_xyz, right, left).sum()),
        }


def _defined(value: float) -> float | None:
    """Return a score, or None for NaN, which JSON lacks."""
    return float(value) if math.isfinite(value) else None


def shrunk_rows(level: int) -> int:
    """Return the rows of a panorama with pixels as large as those of tangent images of a level.

    The pixels of tangent images are R_v(b−1)/2^(s−b) wide, those of the panorama π/2^(s+1): the
    number of rows is 0.709 times as large. Fewer, larger pixels have less noise, an advantage
    that is unrelated to distortion. Pixels of base levels 0 and 1 are equal; those of base level 2
    are 6 % larger.

    >>> shrunk_rows(10)
    1453
    """
    return round(math.pi / TangentGrid(0, level).pitch)


def _shrunk(rgb: NDArray[np.uint8], rows: int) -> NDArray[np.uint8]:
    """Downsample a panorama by area averaging if it has more rows."""
    if rgb.shape[0] <= rows:
        return rgb
    return cv2.resize(rgb, (2 * rows, rows), interpolation=cv2.INTER_AREA)
