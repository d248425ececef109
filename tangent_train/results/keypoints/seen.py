"""What depth and pose say of a pair: what both panoramas see, which matches are right."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tangent_train.geometry import PanoramaPose
from tangent_train.keypoints.covisibility import (
    DepthView,
    correct_matches,
    fov_overlap,
    visible_count,
)
from tangent_train.keypoints.scores import PairScores
from tangent_train.results.keypoints.entries import Scored, defined

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair
    from tangent_train.results.keypoints.found import Found

__all__ = ["Seen"]


class Seen:
    """Scores matches of one pair, with depth and pose where they are known.

    Args:
        pair: The pair.
        max_error_deg: How far off a match may be that is right.
    """

    def __init__(self, pair: PanoramaPair, max_error_deg: float) -> None:
        views = [_view(side) for side in (pair.left, pair.right)]
        left, right = views
        self._views = None if left is None or right is None else (left, right)
        self._max_error_deg = max_error_deg

    @property
    def has_geometry(self) -> bool:
        """Whether depth and pose of both are known."""
        return self._views is not None

    def fov_overlap(self) -> float | None:
        """Overlap of the fields of view; None where depth or pose is unknown."""
        return None if self._views is None else defined(fov_overlap(*self._views))

    def scored(
        self, found: Found, turn: NDArray[np.float64], condition: str, representation: str
    ) -> Scored:
        """The figures of one way to match.

        Args:
            found: Keypoints, matches and geometry.
            turn: ``(3, 3)`` rotation that the right panorama was turned by.
            condition: Its name.
            representation: What keypoints were detected on.
        """
        counts = len(found.left), len(found.right)
        inliers = int(found.geometry.inliers.sum())
        visible = counts
        truth: dict[str, Any] = {}
        if self._views is not None:
            visible, truth = _truth(found, turn, self._views, self._max_error_deg)
        scores = PairScores(len(found.matches), inliers, *visible)
        return Scored(
            condition=condition,
            representation=representation,
            keypoints_left=counts[0],
            keypoints_right=counts[1],
            visible_left=visible[0],
            visible_right=visible[1],
            putative=scores.putative,
            inliers=scores.inliers,
            pmr=defined(scores.pmr),
            ms=defined(scores.ms),
            p=defined(scores.precision),
            kind=found.geometry.kind,
            **truth,
        )


def _truth(
    found: Found,
    turn: NDArray[np.float64],
    views: tuple[DepthView, DepthView],
    max_error_deg: float,
) -> tuple[tuple[int, int], dict[str, Any]]:
    """Visible keypoints, and the figures that need the truth."""
    left, right = views
    left_xyz = found.left.directions_xyz
    # Back to the right panorama as it is, whose depth needs no resampling.
    right_xyz = found.right.directions_xyz @ turn
    visible = visible_count(left_xyz, left, right), visible_count(right_xyz, right, left)
    first, second = found.matches.T
    judged = correct_matches(left_xyz[first], right_xyz[second], left, right, max_error_deg)
    turned = PanoramaPose(right.pose.world_from_panorama @ turn.T, right.pose.location_m)
    errors = found.geometry.pose_error_deg(left.pose, turned)
    return visible, {
        "rotation_error_deg": defined(errors[0]),
        "translation_error_deg": defined(errors[1]),
        "judged": int(judged.known.sum()),
        "correct": int(judged.correct.sum()),
    }


def _view(panorama: PairedPanorama) -> DepthView | None:
    if panorama.distance_m is None or panorama.pose is None:
        return None
    return DepthView(panorama.distance_m, panorama.pose)
