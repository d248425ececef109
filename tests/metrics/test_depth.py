from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchmetrics.utilities import dim_zero_cat

from tangent_train.geometry import equirect_solid_angles
from tangent_train.metrics.collected import DepthMetric
from tangent_train.metrics.depth import (
    Alignment,
    DepthProtocol,
    depth_scores,
    error_sums,
    mean_depth_scores,
    scaled_and_shifted,
)
from tangent_train.metrics.image_sums import as_sums, drawn_scores, intervals, means_of_sums

Image = tuple[NDArray[np.float64], NDArray[np.float64]]


def _image(seed: int, shape: tuple[int, ...] = (12, 24)) -> Image:
    """Predicted and true distances in meters; both have holes."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.5, 12, shape)
    prediction = truth * np.exp(rng.normal(0, 0.3, shape))
    truth[rng.random(shape) < 0.1] = np.nan
    prediction[rng.random(shape) < 0.1] = np.nan
    return prediction, truth


def _in_loops(prediction: Any, truth: Any, weights: Any) -> dict[str, float]:
    """The scores of one image, pixel by pixel, in the words of the module's docstring."""
    total = seen = 0.0
    sums = dict.fromkeys(("absrel", "sqrel", "rmse", "rmse_log", "mae", "1", "2", "3"), 0.0)
    for d, g, w in zip(prediction.ravel(), truth.ravel(), weights.ravel(), strict=True):
        if math.isnan(g) or w == 0:
            continue
        total += w
        if math.isnan(d):
            continue
        seen += w
        sums["absrel"] += w * abs(d - g) / g
        sums["sqrel"] += w * (d - g) ** 2 / g
        sums["rmse"] += w * (d - g) ** 2
        sums["rmse_log"] += w * (math.log(d) - math.log(g)) ** 2
        sums["mae"] += w * abs(d - g)
        for n in (1, 2, 3):
            sums[str(n)] += w * (max(d / g, g / d) < 1.25**n)
    means = {name: value / seen for name, value in sums.items() if not name.isdigit()}
    means |= {name: math.sqrt(means[name]) for name in ("rmse", "rmse_log")}
    shares = {f"delta{n}": sums[n] / total for n in "123"}
    return means | shares | {"missing": 1 - seen / total}


def test_scores_equal_loops_by_pixels_by_solid_angle_and_in_latitude_bands() -> None:
    prediction, truth = _image(0)
    sums = error_sums(torch.from_numpy(prediction), torch.from_numpy(truth)).numpy()
    rows = np.arange(12)[:, None] + np.zeros((1, 24))
    angles = np.broadcast_to(equirect_solid_angles((12, 24))[:, None], (12, 24))
    # 12 rows of 15°: two rows in each band of 30°.
    weights = [np.ones((12, 24)), angles, *(rows // 2 == band for band in range(6))]
    beside = np.isin(np.arange(24), [0, 23]) + np.zeros((12, 1))  # 5 % of 24 columns
    weights += [angles * np.isin(rows, [0, 1, 10, 11]), angles * np.isin(rows, [4, 5, 6, 7])]
    weights += [angles * beside, angles * (1 - beside)]
    for of_weighting, weight in zip(sums[:-1], weights, strict=True):
        expected = _in_loops(prediction, truth, weight)
        assert {n: float(s) for n, s in depth_scores(of_weighting).items()} == pytest.approx(
            expected, rel=1e-12
        )


def test_the_crops_of_a_photo_are_one_image_without_solid_angles() -> None:
    prediction, truth = _image(1, (3, 5, 4))
    sums = error_sums(torch.from_numpy(prediction), torch.from_numpy(truth)).numpy()
    assert depth_scores(sums[0]) == pytest.approx(_in_loops(prediction, truth, np.ones((3, 5, 4))))
    assert not sums[1:].any()


def test_images_count_the_same_and_images_without_truth_do_not_count() -> None:
    images = [_image(3), _image(4, (30, 60)), (np.ones((6, 12)), np.full((6, 12), np.nan))]
    metric = DepthMetric()
    for prediction, truth in images:
        metric.update(torch.from_numpy(prediction), torch.from_numpy(truth))
    of_each = [_in_loops(p, g, np.ones(p.shape)) for p, g in images[:2]]
    means = mean_depth_scores(metric.compute()[:, 0])
    assert means == pytest.approx({n: (of_each[0][n] + of_each[1][n]) / 2 for n in of_each[0]})
    metric.reset()
    empty = dim_zero_cat(metric.of_images).numpy()
    assert empty.shape == (0, 13, 10)
    assert all(math.isnan(value) for value in mean_depth_scores(empty[:, 0]).values())


@pytest.mark.filterwarnings("error")
def test_intervals_contain_the_mean_and_leave_out_images_without_truth() -> None:
    sums = np.stack(
        [error_sums(*map(torch.from_numpy, _image(k))).numpy()[0] for k in range(12)]
        + [np.zeros(10)]
    )
    numbers = as_sums(depth_scores(sums))
    found, means = intervals(drawn_scores(numbers)), mean_depth_scores(sums)
    assert means_of_sums(numbers) == pytest.approx(means)
    assert found.keys() == means.keys()
    for name, (low, high) in found.items():
        assert low <= means[name] <= high, name
    scores = depth_scores(sums[:12])["absrel"]  # the mean of 12 numbers: ± 1.96 standard errors
    error = scores.std(ddof=1) / math.sqrt(12)
    low, high = found["absrel"]
    assert (high - low) / (2 * 1.96 * error) == pytest.approx(1, abs=0.15)
    assert drawn_scores(as_sums(depth_scores(sums[:1]))) == {}


@pytest.mark.parametrize("quantity", ["distance", "disparity"])
@pytest.mark.parametrize("alignment", get_args(Alignment))
def test_alignments_equal_least_squares_of_numpy(alignment: Alignment, quantity: Any) -> None:
    prediction, truth = _image(5)
    used = ~np.isnan(prediction) & ~np.isnan(truth)
    if used.sum() % 2:  # an even number has two middle values
        truth[tuple(np.argwhere(used)[0])] = np.nan
        used = ~np.isnan(prediction) & ~np.isnan(truth)

    def as_quantity(x: Any) -> Any:
        return x if quantity == "distance" else 1 / x

    p, g = as_quantity(prediction), as_quantity(truth)
    medians = [np.median(x[used]) for x in (g, p)]
    fits: dict[str, Any] = {
        "none": (1.0, 0.0),
        "median": (medians[0] / medians[1], 0.0),
        "scale": (np.linalg.lstsq(p[used][:, None], g[used])[0][0], 0.0),
        "affine": np.polyfit(p[used], g[used], 1),
    }
    scale, shift = fits[alignment]
    expected = as_quantity(scale * p + shift)
    expected[~(expected > 0)] = np.nan
    aligned = DepthProtocol(alignment, quantity).aligned(
        torch.from_numpy(prediction), torch.from_numpy(truth)
    )
    np.testing.assert_allclose(aligned.numpy(), expected, rtol=1e-9)


def test_disparities_that_an_alignment_makes_negative_are_far_away() -> None:
    """``clip`` makes them the largest distance; without it they are unknown."""
    truth = torch.tensor([[1.0, 2.0, 4.0, 8.0, torch.nan]])
    prediction = 1 / (1 / truth + 0.1)  # the shift of the fit is −0.1
    prediction[0, 4] = 20.0
    for clip, expected in ((True, 10.0), (False, torch.nan)):
        protocol = DepthProtocol("affine", "disparity", max_distance=10.0, clip=clip)
        aligned = protocol.aligned(prediction, truth)
        torch.testing.assert_close(aligned[:, :4], truth[:, :4])
        torch.testing.assert_close(aligned[0, 4], torch.tensor(expected), equal_nan=True)


def test_scale_and_shift_of_each_image_are_those_of_least_squares() -> None:
    values, truth = (
        torch.from_numpy(np.stack(x)) for x in zip(*map(_image, range(4)), strict=True)
    )
    values, truth[2] = (2 - 0.3 * values.nan_to_num(5)).requires_grad_(), torch.nan
    found = scaled_and_shifted(values, truth)
    for x, g, y in zip(values.detach(), truth, found.detach(), strict=True):
        known = ~g.isnan()
        if known.any():
            fit = np.polyfit(x[known].numpy(), g[known].numpy(), 1)
            torch.testing.assert_close(y, fit[0] * x + fit[1])
    known = ~truth.isnan()
    (gradient,) = torch.autograd.grad((found - truth)[known].square().sum(), values)
    assert gradient.isfinite().all()
    assert found.isfinite().all()
    constant = scaled_and_shifted(torch.ones_like(truth), truth)
    torch.testing.assert_close(constant[0], truth[0].nanmean().expand(12, 24))


def test_limits_ignore_true_distances_and_clip_predictions_only_if_asked() -> None:
    truth = torch.tensor([[0.05, 1.0, 9.0, 11.0], [2.0, torch.nan, 0.0, 10.0]])
    prediction = torch.tensor([[9.0, 1.0, 30.0, 1.0], [-2.0, 1.0, 1.0, torch.inf]])
    near, clipped = DepthProtocol("none", "distance", 0.1, 10.0), {"clip": True}
    limited = near.limited(truth)
    assert limited.isnan().tolist() == [[True, False, False, True], [False, True, True, False]]
    scores = depth_scores(error_sums(near.aligned(prediction, truth), limited).numpy()[0])
    assert scores["mae"] == pytest.approx((0 + 21) / 2)  # two of four have a prediction
    assert scores["missing"] == pytest.approx(2 / 4)
    assert scores["delta1"] == pytest.approx(1 / 4)  # a missing prediction is wrong
    near = DepthProtocol("none", "distance", 0.1, 10.0, **clipped)
    scores = depth_scores(error_sums(near.aligned(prediction, truth), limited).numpy()[0])
    assert scores["mae"] == pytest.approx((0 + 1 + 0) / 3)
    assert near.facts == {"alignment": "none", "range": "0.1 to 10 m, predictions clipped"}
