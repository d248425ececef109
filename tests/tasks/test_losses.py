from __future__ import annotations

import itertools
import math
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tangent_train.errors import SettingError
from tangent_train.tasks.losses import (
    AuxiliaryTarget,
    RegionLoss,
    auxiliary_sum,
    check_region_loss,
    cross_entropy_norm,
    cross_entropy_sum,
    region_norm,
    region_sum,
)


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_sum_over_norm_is_the_weighted_mean(smoothing: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scores = torch.randn(4, 5, 6, 7, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, 5, (4, 6, 7), generator=generator).to(torch.uint8)
    weights = torch.rand(5, generator=generator, dtype=torch.float64) + 0.1
    total = cross_entropy_sum(scores, labels, weights, smoothing)
    norm = cross_entropy_norm(labels, weights)
    expected = functional.cross_entropy(
        scores, labels.long(), weights, ignore_index=0, label_smoothing=smoothing
    )
    torch.testing.assert_close(total / norm, expected)


def test_parts_add_up_to_the_gradient_of_the_whole() -> None:
    scores = torch.randn(6, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    labels = torch.randint(1, 3, (6, 4, 4)).to(torch.uint8)
    labels[:4, :3] = 0  # unknown pixels spread unevenly
    weights = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    whole = cross_entropy_sum(scores, labels, weights)
    norm = cross_entropy_norm(labels, weights)
    (expected,) = torch.autograd.grad(whole / norm, scores)
    parts = [cross_entropy_sum(scores[k : k + 2], labels[k : k + 2], weights) for k in (0, 2, 4)]
    (summed,) = torch.autograd.grad(sum(parts) / norm, scores)
    torch.testing.assert_close(summed, expected)


def test_nothing_labelled_gives_zero_and_no_nan() -> None:
    scores = torch.randn(1, 3, 2, 2, requires_grad=True)
    labels, weights = torch.zeros(1, 2, 2, dtype=torch.uint8), torch.ones(3)
    assert float(cross_entropy_norm(labels, weights)) == 0
    (gradient,) = torch.autograd.grad(cross_entropy_sum(scores, labels, weights), scores)
    assert float(gradient.abs().max()) == 0


def test_half_precision_does_not_overflow() -> None:
    labels = torch.full((2, 300, 300), 2, dtype=torch.uint8)
    weights = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float16)
    norm = cross_entropy_norm(labels, weights)
    assert float(norm) == 3 * labels.numel()
    scores = torch.zeros(2, 3, 300, 300, dtype=torch.float16)
    mean = cross_entropy_sum(scores, labels, weights) / norm
    assert float(mean) == pytest.approx(math.log(3), rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_the_norm_is_exact_under_autocast(dtype: torch.dtype) -> None:
    labels = torch.full((2, 300, 301), 2, dtype=torch.uint8)
    weights = torch.tensor([0.0, 1.0, 3.0])
    with torch.autocast("cpu", dtype):
        assert float(cross_entropy_norm(labels, weights)) == 3 * labels.numel()


# --- auxiliary ---------------------------------------------------------------------------------


def _labels(*shape: int, classes: int = 5, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, classes, shape, generator=generator).to(torch.uint8)


def _scores(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()


WEIGHTS = torch.tensor([7.0, 1.0, 0.5, 2.0, 0.0], dtype=torch.float64)
SIZES = [(1, 1), (3, 4), (6, 8), (5, 7), (4, 3), (12, 16), (13, 5), (24, 16)]


@pytest.mark.parametrize("size", SIZES)
def test_histograms_give_the_loss_of_enlarged_scores(size: tuple[int, int]) -> None:
    scores, labels = _scores(3, 5, *size), _labels(3, 12, 16)
    found = auxiliary_sum(scores, labels, WEIGHTS)
    # Cells by the centres of the pixels, one by one.
    rows = [math.floor(Fraction(2 * r + 1, 2 * 12) * size[0]) for r in range(12)]
    columns = [math.floor(Fraction(2 * c + 1, 2 * 16) * size[1]) for c in range(16)]
    enlarged = scores[:, :, rows][:, :, :, columns]
    expected = cross_entropy_sum(enlarged, labels, WEIGHTS)
    torch.testing.assert_close(found, expected)
    gradients = (torch.autograd.grad(value, scores)[0] for value in (found, expected))
    torch.testing.assert_close(*gradients)
    torch.testing.assert_close(
        enlarged, functional.interpolate(scores, (12, 16), mode="nearest-exact")
    )


@pytest.mark.parametrize("target", ["histogram", "labels"])
def test_cells_of_pixels_of_one_class_are_compared_with_it(target: AuxiliaryTarget) -> None:
    scores, coarse = _scores(2, 5, 3, 4), _labels(2, 3, 4)
    labels = coarse.repeat_interleave(5, 1).repeat_interleave(7, 2)
    found = auxiliary_sum(scores, labels, WEIGHTS, target) / cross_entropy_norm(labels, WEIGHTS)
    expected = functional.cross_entropy(scores, coarse.long(), WEIGHTS, ignore_index=0)
    torch.testing.assert_close(found, expected)


def test_labels_are_those_at_the_centres() -> None:
    scores, labels = _scores(2, 5, 3, 4), _labels(2, 9, 20)
    found = auxiliary_sum(scores, labels, WEIGHTS, "labels")
    central = labels[:, [1, 4, 7]][:, :, [2, 7, 12, 17]]
    torch.testing.assert_close(found, 15 * cross_entropy_sum(scores, central, WEIGHTS))


@pytest.mark.parametrize("target", ["histogram", "labels"])
@pytest.mark.parametrize("size", [(3, 4), (12, 16)])
def test_auxiliary_parts_add_up_and_unknown_counts_for_nothing(
    target: AuxiliaryTarget, size: tuple[int, int]
) -> None:
    scores, labels = _scores(4, 5, *size), _labels(4, 12, 16)
    labels[1] = 0
    whole = auxiliary_sum(scores, labels, WEIGHTS, target)
    parts = [auxiliary_sum(scores[k:e], labels[k:e], WEIGHTS, target) for k, e in ((0, 3), (3, 4))]
    torch.testing.assert_close(torch.stack(parts).sum(), whole)
    (gradient,) = torch.autograd.grad(whole, scores)
    assert float(gradient[1].abs().max()) == 0
    assert float(gradient[0].abs().max()) > 0


@pytest.mark.parametrize("target", ["histogram", "labels"])
def test_auxiliary_losses_are_not_computed_in_half_precision(target: AuxiliaryTarget) -> None:
    labels = torch.full((4, 300, 300), 2, dtype=torch.uint8)
    scores = torch.zeros(4, 3, 10, 10, dtype=torch.float16)
    weights = torch.ones(3, dtype=torch.float16)
    with torch.autocast("cpu", torch.bfloat16):
        found = auxiliary_sum(scores, labels, weights, target)
    assert float(found) == pytest.approx(labels.numel() * math.log(3), rel=1e-5)


# --- regions -----------------------------------------------------------------------------------


def _lovasz(probabilities: NDArray[np.float64], truth: NDArray[np.uint8]) -> float:
    """Of one image: the Lovász extension as an integral of 1 - IoU over thresholds of the error."""
    known = truth > 0
    losses = []
    for c in np.unique(truth[known]):
        inside = truth[known] == c
        errors = np.abs(inside - probabilities[c][known])
        levels = np.concatenate([[0], np.sort(errors)])
        loss = 0.0
        for low, high in itertools.pairwise(levels):
            wrong = errors > low
            loss += (high - low) * wrong.sum() / (inside | wrong).sum()
        losses.append(loss)
    return float(np.mean(losses))


def _dice(probabilities: NDArray[np.float64], truth: NDArray[np.uint8]) -> float:
    known = truth > 0
    losses = []
    for c in np.unique(truth[known]):
        inside, share = truth[known] == c, probabilities[c][known]
        losses.append(1 - 2 * share[inside].sum() / (share.sum() + inside.sum()))
    return float(np.mean(losses))


@pytest.mark.parametrize(("loss", "reference"), [("lovasz", _lovasz), ("dice", _dice)])
def test_region_losses_by_their_definition(loss: RegionLoss, reference: object) -> None:
    scores, labels = _scores(5, 5, 6, 7), _labels(5, 6, 7)
    labels[1] = 0  # an image of which nothing is known
    labels[2, :, 1:] = 0
    labels[3] = 3
    labels[4, labels[4] == 2] = 1  # a class is absent
    probabilities = scores.detach().softmax(1).numpy()
    assert callable(reference)
    expected = [reference(probabilities[k], labels[k].numpy()) for k in (0, 2, 3, 4)]
    found = region_sum(scores.detach(), labels, loss)
    assert float(found) == pytest.approx(sum(expected), rel=1e-5)
    assert float(region_norm(labels)) == 4


@pytest.mark.parametrize("loss", ["lovasz", "dice"])
def test_region_parts_add_up_and_unknown_counts_for_nothing(loss: RegionLoss) -> None:
    scores, labels = _scores(5, 5, 6, 7), _labels(5, 6, 7)
    labels[0] = 0
    labels[3, 2:] = 0
    (expected,) = torch.autograd.grad(region_sum(scores, labels, loss), scores)
    parts = [region_sum(scores[k : k + 2], labels[k : k + 2], loss) for k in (0, 2, 4)]
    (found,) = torch.autograd.grad(torch.stack(parts).sum(), scores)
    torch.testing.assert_close(found, expected)
    assert float(found[0].abs().max()) == 0
    assert float(found[3, :, 2:].abs().max()) == 0
    assert float(found[3, :, :2].abs().max()) > 0


@pytest.mark.parametrize("loss", ["lovasz", "dice"])
def test_region_losses_of_right_and_of_no_labels(loss: RegionLoss) -> None:
    labels = _labels(3, 8, 8).clamp(min=1)
    right = 100 * functional.one_hot(labels.long(), 5).movedim(-1, 1).double()
    assert float(region_sum(right, labels, loss)) == pytest.approx(0, abs=1e-6)
    assert float(region_sum(-right, labels, loss)) == pytest.approx(3, abs=1e-6)
    scores = _scores(3, 5, 8, 8)
    nothing = region_sum(scores, torch.zeros_like(labels), loss)
    (gradient,) = torch.autograd.grad(nothing, scores)
    assert nothing.item() == gradient.abs().max().item() == 0
    assert float(region_norm(torch.zeros_like(labels))) == 0


@pytest.mark.parametrize("loss", ["lovasz", "dice"])
def test_region_losses_are_not_computed_in_half_precision(loss: RegionLoss) -> None:
    scores, labels = _scores(2, 3, 100, 100), _labels(2, 100, 100, classes=3)
    half = scores.detach().half()
    with torch.autocast("cpu", torch.bfloat16):
        found = region_sum(half, labels, loss)
    assert found.dtype == torch.float32
    expected = float(region_sum(half.double(), labels, loss))
    assert float(found) == pytest.approx(expected, rel=1e-4)


def test_unknown_region_losses_and_a_missing_package_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("none", "lovasz", "dice"):
        check_region_loss(name)
    with pytest.raises(SettingError, match="'jaccard'; expected none, lovasz or dice"):
        check_region_loss("jaccard")
    monkeypatch.setitem(sys.modules, "segmentation_models_pytorch", None)
    check_region_loss("none")
    with pytest.raises(SettingError, match=r"pip install 'tangent-train\[networks\]'"):
        check_region_loss("dice")
