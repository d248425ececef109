"""Kinds of output of networks, and the corrections of depth views."""

from __future__ import annotations

from typing import Literal

ScoreKind = Literal["logits", "probabilities", "labels"]
"""Output of a network.

* `logits`: scores before a softmax over the K classes.
* `probabilities`: scores after that softmax.
* `labels`: label maps ``(B, h, w)`` or ``(B, 1, h, w)``. NaN and values outside 0 … K − 1 belong to
  index K.

A single score is that of a sigmoid. A score of 0 is appended at index 1, "not of the class", which
wins where the probability is below ½.
"""

Align = Literal["none", "scale", "affine", "grid"]
"""Correction of each view: none; a scale; a scale and a shift; or a coarse grid of scales."""

Upright = Literal["pose", "auto"] | None
"""Source of the up direction of a panorama."""

MOST_ROTATIONS = 360
"""Largest number of rotations of the views of a panorama to average over."""

DepthKind = Literal[
    "log_distance",
    "metric_distance",
    "metric_z",
    "canonical_z",
    "canonical_inverse",
    "relative_z",
    "relative_depth",
    "relative_disparity",
    "relative_points",
]
"""Output of a depth network at the pixels of its images, a channel of values or three.

* `log_distance`: natural logarithm of the distance along the ray in meters; trained with
  `DistanceHead`.
* `metric_distance`: distance along the ray in meters.
* `metric_z`: z-depth in meters, the distance times the cosine of the angle to the optical axis.
* `canonical_z`: z-depth in meters of a camera whose focal length is the width of the image; z-depth
  is proportional to the focal length. Also the output of a network of `metric_z` whose camera is
  known, see `OutputNetwork`.
* `canonical_inverse`: 1 / z-depth, in meters if the focal length were the width of the image, as of
  Depth Pro.
* `relative_z`: z-depth up to a scale per image.
* `relative_depth`: z-depth up to a scale and a shift per image.
* `relative_disparity`: 1 / z-depth up to a scale and a shift per image.
* `relative_points`: points (x to the right, y down, z ahead) up to a scale and a shift of z per
  image, as of MoGe; three channels, first or last.

In views that are not pinhole images (equirectangular images, icospheres), z-depth is the distance.
"""


def depth_channels(kind: DepthKind) -> int:
    """Return the number of channels of the output of a depth network."""
    return 3 if kind == "relative_points" else 1
