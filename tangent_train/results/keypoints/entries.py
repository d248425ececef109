"""What is found out about pairs of panoramas, as it is kept in ``results.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

__all__ = ["AS_GIVEN", "EASY", "HARD", "TURNED", "PairEntry", "Scored", "defined", "with_splits"]

AS_GIVEN = "as_given"
"""Both panoramas as they are."""

TURNED = "turned"
"""The right panorama turned by a random rotation."""

EASY, HARD = "easy", "hard"


@dataclass(frozen=True)
class Scored:
    """The matches of one pair, of one representation, in one condition.

    Attributes:
        condition: `AS_GIVEN` or `TURNED`.
        representation: See `Representations.names`.
        keypoints_left: Keypoints of the left panorama.
        keypoints_right: Of the right one.
        visible_left: n_L, those of the left that are visible to the right; all where depth and
            pose are unknown.
        visible_right: n_R.
        putative: p, matches.
        inliers: f, matches that one geometry explains.
        pmr: Putative matching ratio; None where not defined.
        ms: Matching score; None where not defined.
        p: Precision; None where not defined.
        kind: Of the two-view geometry.
        rotation_error_deg: Of the estimated geometry, where the pose is known.
        translation_error_deg: Angle between the estimated direction and the true one.
        judged: Matches whose truth is known from depth and pose; None without them.
        correct: Those of them that are right.
    """

    condition: str
    representation: str
    keypoints_left: int
    keypoints_right: int
    visible_left: int
    visible_right: int
    putative: int
    inliers: int
    pmr: float | None
    ms: float | None
    p: float | None
    kind: str
    rotation_error_deg: float | None = None
    translation_error_deg: float | None = None
    judged: int | None = None
    correct: int | None = None

    @property
    def correct_share(self) -> float | None:
        """The share of matches that are right, of those whose truth is known."""
        return self.correct / self.judged if self.judged and self.correct is not None else None


@dataclass(frozen=True)
class PairEntry:
    """What is known of one pair.

    Attributes:
        name: See `PanoramaPair`.
        split: Given by the data or by `with_splits`.
        left: Name of the left panorama.
        right: Name of the right one.
        rows: Of the larger panorama.
        level: Level s that keypoints were detected at.
        fov_overlap: Computed from depth and pose, 0 to 1; or None.
        has_geometry: Whether depth and pose are known.
        scored: In the order of conditions and representations.
        seconds: What it took.
        error: Why the pair could not be used; the rest is empty then.
    """

    name: str
    split: str | None = None
    left: str = ""
    right: str = ""
    rows: int = 0
    level: int = 0
    fov_overlap: float | None = None
    has_geometry: bool = False
    scored: tuple[Scored, ...] = ()
    seconds: float = 0.0
    error: str | None = None

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> PairEntry:
        """The entry that `as_dict` gave.

        Raises:
            TypeError: It is none.
        """
        scored = tuple(Scored(**figures) for figures in plain.get("scored", ()))
        return cls(**{**plain, "scored": scored})

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)

    def of_condition(self, condition: str) -> dict[str, Scored]:
        """What was found in a condition, by representation."""
        return {s.representation: s for s in self.scored if s.condition == condition}

    @property
    def without_keypoints(self) -> list[str]:
        """Names of the panoramas on which no representation has a keypoint, as they are."""
        scored = list(self.of_condition(AS_GIVEN).values())
        counts = {
            self.left: sum(s.keypoints_left for s in scored),
            self.right: sum(s.keypoints_right for s in scored),
        }
        return [name for name, count in counts.items() if scored and not count]


def with_splits(entries: Sequence[PairEntry]) -> list[PairEntry]:
    """Divide pairs in two halves by their overlaps, as the paper's are, where no split is given.

    Args:
        entries: Of all pairs; those that could not be used are left out.

    Returns:
        The half with the smaller overlaps is `HARD`, the other, which may have one more, `EASY`.
        Nothing is divided where an overlap is unknown or all are the same.
    """
    entries = [entry for entry in entries if entry.error is None]
    overlaps = [entry.fov_overlap for entry in entries]
    if any(entry.split for entry in entries) or None in overlaps or len(set(overlaps)) < 2:
        return entries
    order = np.argsort(np.array(overlaps, np.float64), kind="stable")
    hard = set(order[: len(order) // 2].tolist())
    return [replace(e, split=HARD if k in hard else EASY) for k, e in enumerate(entries)]


def defined(value: float) -> float | None:
    """A figure, or None where it is not defined: JSON has no NaN."""
    return float(value) if math.isfinite(value) else None
