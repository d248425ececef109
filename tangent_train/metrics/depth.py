"""Depth: errors of predicted distances, per image and then over images.

With predicted distances d and true distances g of an image, in meters (Eigen, Puhrsch and Fergus,
NeurIPS 2014, section 4.3):

* AbsRel: mean of ``|d − g| / g``; SqRel: mean of ``(d − g)² / g``; MAE: mean of ``|d − g|``.
* RMSE: root of the mean of ``(d − g)²``; RMSElog: the same of natural logarithms.
* δ1, δ2, δ3: share of pixels with ``max(d/g, g/d)`` below 1.25, 1.25² and 1.25³.

Pixels with a true but without a predicted distance are wrong in δ, have no error in the other
scores, and are reported as a share (``missing``). Each score is that of an image, averaged over the
images that have it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from tangent_train.geometry import equirect_solid_angles
from tangent_train.metrics.image_sums import seam_step
from tangent_train.metrics.scores import BAND_EDGES_DEG, band_of_rows, defined_mean
from tangent_train.metrics.sphere import (
    REGIONS,
    SEAM_SUMS,
    beside_seam,
    row_weights,
    seam_sums,
)

Alignment = Literal["none", "median", "scale", "affine"]
"""Alignment of a prediction with the true distances of the image: ``median`` and ``scale`` multiply
it by a number (the ratio of the medians, or least squares), ``affine`` also adds one (least
squares)."""

Quantity = Literal["distance", "disparity"]
"""Quantity in which predictions are aligned; disparity is the reciprocal of the distance."""

_ERRORS = ("absrel", "sqrel", "rmse", "rmse_log", "mae")
_SHARES = ("delta1", "delta2", "delta3")
SUMS = 2 + len(_ERRORS) + len(_SHARES)
BANDS = slice(2, 1 + len(BAND_EDGES_DEG))
SPHERE = slice(BANDS.stop, None)
WEIGHTINGS = BANDS.stop + len(REGIONS) + 1
"""Weightings of the sums of an image, see `error_sums`; those of the latitude bands, and those for
`sphere_scores`."""

_SEAM = BANDS.stop + REGIONS.index("seam")
_THRESHOLD = 1.25


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DepthProtocol:
    """Comparison of predicted distances with true ones; scores depend on all of its settings.

    Attributes:
        alignment: Alignment of each prediction, see `Alignment`.
        alignment_in: Quantity of the alignment.
        min_distance: Pixels with a smaller true distance, in meters, are ignored.
        max_distance: Pixels with a larger true distance, in meters, are ignored; None for no limit.
        clip: True to clip aligned predictions to these distances.
    """

    alignment: Alignment = "none"
    alignment_in: Quantity = "distance"
    min_distance: Annotated[float, Field(ge=0)] = 0.0
    max_distance: float | None = None
    clip: bool = False

    @property
    def facts(self) -> dict[str, str]:
        """The settings as texts, for the records of scores."""
        quantity = "" if self.alignment == "none" else f" in {self.alignment_in}"
        far = "∞" if self.max_distance is None else f"{self.max_distance:g}"
        clipped = ", predictions clipped" if self.clip else ""
        return {
            "alignment": self.alignment + quantity,
            "range": f"{self.min_distance:g} to {far} m{clipped}",
        }

    def limited(self, truth: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Return true distances in meters, with NaN outside the limits."""
        far = torch.inf if self.max_distance is None else self.max_distance
        known = (truth > 0) & (truth >= self.min_distance) & (truth <= far)
        return torch.where(known, truth, torch.nan)

    def aligned(
        self,
        prediction: Float[Tensor, "*shape"],
        truth: Float[Tensor, "*shape"],
        ray_lengths: Tensor | None = None,
    ) -> Float[Tensor, "*shape"]:
        """Align the prediction for an image with its true distances, and clip it.

        Args:
            prediction: Predicted distances in any unit; NaN where unknown.
            truth: True distances in meters; NaN where unknown or outside the limits.
            ray_lengths: Distance divided by z-depth of the pixels of a photo, whose z-depth is
                aligned; None for a panorama.

        Returns:
            Distances in meters; NaN where unknown, or where the alignment makes them negative.
        """
        distances = torch.where(prediction > 0, prediction.double(), torch.nan)
        lengths = 1.0 if ray_lengths is None else ray_lengths.double()
        used = (truth > 0) & distances.isfinite()
        if self.alignment != "none" and used.any():
            power = -1 if self.alignment_in == "disparity" else 1
            values, true = (distances / lengths) ** power, (truth.double() / lengths) ** power
            if self.alignment == "affine":
                values = scaled_and_shifted(values, true.where(used, torch.nan))
            else:
                v, t = values[used], true[used]
                is_median = self.alignment == "median"
                values *= _median(t) / _median(v) if is_median else v @ t / (v @ v)
            if power < 0 and self.clip:
                values = values.clamp(min=torch.finfo(values.dtype).tiny)  # far away
            distances = lengths * values**power
        if self.clip:
            distances = distances.clamp(self.min_distance, self.max_distance)
        return torch.where(distances > 0, distances, torch.nan).to(prediction.dtype)


def _median(values: Float[Tensor, " n"]) -> Tensor:
    """Return the mean of both middle values, like NumPy; torch returns the lower one."""
    return (values.median() - (-values).median()) / 2


def scaled_and_shifted(
    values: Float[Tensor, "*images height width"], truth: Float[Tensor, "*images height width"]
) -> Float[Tensor, "*images height width"]:
    """Scale and shift values of each image by least squares, as far as the truth is known.

    This is the alignment of Ranftl et al. (TPAMI 2022, equation 4). It can be differentiated.

    Args:
        values: Values of any scale and shift; finite where the truth is known.
        truth: True values; NaN where unknown.
    """
    known = ~truth.isnan()
    counts = known.sum(dim=(-2, -1), keepdim=True).clamp(min=1)

    def mean(x: Tensor) -> Tensor:
        return x.where(known, 0).sum(dim=(-2, -1), keepdim=True) / counts

    true = truth.where(known, 0)  # without NaN, whose gradients would be NaN too
    centered, true_mean = values - mean(values), mean(true)
    variance = mean(centered.square()).clamp(min=torch.finfo(values.dtype).eps)
    return centered * (mean(centered * (true - true_mean)) / variance) + true_mean


def error_sums(
    prediction: Float[Tensor, "*shape"], truth: Float[Tensor, "*shape"]
) -> Float[Tensor, "weightings sums"]:
    """Sum the errors of one panorama ``(H, W)``, or of the crops of one photo ``(n, h, w)``.

    Args:
        prediction: Predicted distances in meters; NaN where unknown.
        truth: True distances in meters; NaN where unknown.

    Returns:
        ``(13, 10)`` float64 sums by weighting: pixels, solid angles, pixels of the latitude bands
        `BAND_EDGES_DEG`, solid angles of `REGIONS`, and `seam_sums` at the end; all but the first
        are 0 for photos. See `depth_scores`.
    """
    known = truth > 0  # False for NaN
    predicted = known & (prediction > 0) & prediction.isfinite()
    d, g = (torch.where(predicted, x, 1.0).double() for x in (prediction, truth))
    away, ratio = (d - g).abs(), torch.maximum(d / g, g / d)
    values = [known, predicted, away / g, away**2 / g, away**2, (d / g).log() ** 2, away]
    values += [predicted & (ratio < _THRESHOLD**n) for n in (1, 2, 3)]
    weights = torch.from_numpy(_row_weights(tuple(truth.shape))).to(truth.device)
    rows = torch.stack([value.double().flatten(1).sum(dim=1) for value in values], dim=1)
    sums = torch.zeros((WEIGHTINGS, SUMS), dtype=torch.float64, device=truth.device)
    sums[: len(weights)] = weights @ rows
    if truth.ndim == 2:
        beside = torch.as_tensor(beside_seam(truth.shape[1]), device=truth.device)
        near = torch.stack([value[:, beside].double().sum(dim=1) for value in values], dim=1)
        sums[_SEAM] = weights[1] @ near
        sums[_SEAM + 1] = sums[1] - sums[_SEAM]
        logs = (torch.where(predicted, x, torch.nan).log() for x in (prediction, truth))
        steps = [(log - log.roll(-1, 1)).abs().cpu().numpy() for log in logs]
        at_seam = seam_sums(steps[0], steps[1], ~np.isnan(steps[1]))
        sums[-1, :SEAM_SUMS] = torch.from_numpy(at_seam).to(truth.device)
    return sums


@lru_cache(maxsize=4)
def _row_weights(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the weights of the rows of a panorama, or of the crops of a photo."""
    if len(shape) != 2:
        return np.ones((1, shape[0]))
    bands = np.eye(len(BAND_EDGES_DEG) - 1)[:, band_of_rows(shape[0])]
    angles = equirect_solid_angles((shape[0], shape[1]))
    return np.stack([np.ones(shape[0]), angles, *bands, *row_weights(shape[0])])


def depth_scores(sums: Float[np.ndarray, "*some sums"]) -> dict[str, NDArray[np.float64]]:
    """Compute the scores of images, or of parts of images, from the sums of their errors.

    Args:
        sums: Results of `error_sums`.

    Returns:
        Scores by name; NaN without pixels to compute them from.
    """
    known, predicted = (np.where(x > 0, x, np.nan) for x in (sums[..., 0], sums[..., 1]))
    means = dict(zip(_ERRORS, np.moveaxis(sums[..., 2:7], -1, 0) / predicted, strict=True))
    shares = dict(zip(_SHARES, np.moveaxis(sums[..., 7:], -1, 0) / known, strict=True))
    roots = {name: np.sqrt(means[name]) for name in ("rmse", "rmse_log")}
    return means | roots | shares | {"missing": 1 - sums[..., 1] / known}


def mean_depth_scores(sums: Float[np.ndarray, "images sums"]) -> dict[str, float]:
    """Return the means of the scores over the images that have them.

    Args:
        sums: Sums of each image with one weighting.
    """
    return {name: float(defined_mean(scores)) for name, scores in depth_scores(sums).items()}


def sphere_scores(sums: Float[np.ndarray, "images regions sums"]) -> dict[str, NDArray[np.float64]]:
    """Compute the scores of panoramas that only panoramas have: gaps of AbsRel, see `REGIONS`.

    Args:
        sums: Sums of each image with the weightings `SPHERE`.

    Returns:
        Scores by name; NaN where they are undefined.
    """
    poles, horizon, seam, elsewhere = depth_scores(sums[:, :-1])["absrel"].T
    steps = seam_step(sums[:, -1, :SEAM_SUMS])
    return {"pole_gap": poles - horizon, "seam_gap": seam - elsewhere, "seam_step": steps}
