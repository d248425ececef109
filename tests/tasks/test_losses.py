from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from torch.nn import functional

from tangent_train.tasks.losses import auxiliary_sum, cross_entropy_norm, cross_entropy_sum


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_sum_over_norm_is_the_weighted_mean(smoothing: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scores = torch.randn(4, 5, 6, 7, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, 6, (4, 6, 7), generator=generator).to(torch.uint8)
    weights = torch.rand(5, generator=generator, dtype=torch.float64) + 0.1
    total = cross_entropy_sum(scores, labels, weights, smoothing)
    norm = cross_entropy_norm(labels, weights)
    known = labels > 0
    expected = functional.cross_entropy(
        scores.movedim(1, -1)[known], labels[known].long() - 1, weights, label_smoothing=smoothing
    )
    torch.testing.assert_close(total / norm, expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_neither_overflows_nor_rounds(dtype: torch.dtype) -> None:
    labels = torch.full((2, 300, 301), 2, dtype=torch.uint8)
    weights = torch.tensor([1.0, 3.0, 0.5])
    scores = torch.zeros(2, 3, 300, 301, dtype=dtype)
    with torch.autocast("cpu", dtype):
        norms = [cross_entropy_norm(labels, given) for given in (weights, weights.to(dtype))]
        mean = cross_entropy_sum(scores, labels, weights.to(dtype)) / norms[0]
    assert [float(norm) for norm in norms] == [3 * labels.numel()] * 2
    assert float(mean) == pytest.approx(math.log(3), rel=1e-5)


WEIGHTS = torch.tensor([7.0, 1.0, 0.5, 2.0, 0.0], dtype=torch.float64)
SIZES = [(1, 1), (3, 4), (5, 7), (12, 16), (13, 5), (24, 16)]


@pytest.mark.parametrize("size", SIZES)
def test_histograms_give_the_loss_of_enlarged_scores(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 6, (3, 12, 16), generator=generator).to(torch.uint8)
    scores = torch.randn(3, 5, *size, generator=generator, dtype=torch.float64).requires_grad_()
    found = auxiliary_sum(scores, labels, WEIGHTS)
    # Cells by the centers of the pixels, one by one.
    rows = [math.floor(Fraction(2 * r + 1, 2 * 12) * size[0]) for r in range(12)]
    columns = [math.floor(Fraction(2 * c + 1, 2 * 16) * size[1]) for c in range(16)]
    enlarged = scores[:, :, rows][:, :, :, columns]
    expected = cross_entropy_sum(enlarged, labels, WEIGHTS)
    torch.testing.assert_close(found, expected)
    gradients = (torch.autograd.grad(value, scores)[0] for value in (found, expected))
    torch.testing.assert_close(*gradients)
