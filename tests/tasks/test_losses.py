from __future__ import annotations

import math

import pytest
import torch
from torch.nn import functional

from tangent_train.tasks.losses import cross_entropy_norm, cross_entropy_sum


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
