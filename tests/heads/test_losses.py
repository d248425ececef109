from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from torch.nn import functional

from tangent_train.heads import ClassesHead
from tangent_train.heads.distance import log_error_sum


def _head(weights: torch.Tensor, smoothing: float = 0.0) -> ClassesHead:
    head = ClassesHead(["unknown", *map(str, range(len(weights)))], label_smoothing=smoothing)
    head.class_weights = weights
    return head


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_sum_over_norm_is_the_weighted_mean(smoothing: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scores = torch.randn(4, 5, 6, 7, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, 6, (4, 6, 7), generator=generator).to(torch.uint8)
    weights = torch.rand(5, generator=generator, dtype=torch.float64) + 0.1
    head = _head(weights, smoothing)
    total, norm = head.loss_sum(scores, labels), head.loss_norm(labels)
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
        norms = [_head(given).loss_norm(labels) for given in (weights, weights.to(dtype))]
        mean = _head(weights.to(dtype)).loss_sum(scores, labels) / norms[0]
    assert [float(norm) for norm in norms] == [3 * labels.numel()] * 2
    assert float(mean) == pytest.approx(math.log(3), rel=1e-5)


WEIGHTS = torch.tensor([7.0, 1.0, 0.5, 2.0, 0.0], dtype=torch.float64)
SIZES = [(1, 1), (3, 4), (5, 7), (12, 16), (13, 5), (24, 16)]


@pytest.mark.parametrize("size", SIZES)
def test_histograms_give_the_loss_of_enlarged_scores(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 6, (3, 12, 16), generator=generator).to(torch.uint8)
    scores = torch.randn(3, 5, *size, generator=generator, dtype=torch.float64).requires_grad_()
    found = _head(WEIGHTS).auxiliary_sum(scores, labels)
    # Cells by the centers of the pixels, one by one.
    rows = [math.floor(Fraction(2 * r + 1, 2 * 12) * size[0]) for r in range(12)]
    columns = [math.floor(Fraction(2 * c + 1, 2 * 16) * size[1]) for c in range(16)]
    enlarged = scores[:, :, rows][:, :, :, columns]
    expected = _head(WEIGHTS).loss_sum(enlarged, labels)
    torch.testing.assert_close(found, expected)
    gradients = (torch.autograd.grad(value, scores)[0] for value in (found, expected))
    torch.testing.assert_close(*gradients)


def _errors() -> torch.Tensor:
    """Logarithmic errors of four images, one of which is unknown."""
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn(4, 6, 7, generator=generator, dtype=torch.float64)
    errors[torch.rand(4, 6, 7, generator=generator) < 0.2] = torch.nan
    errors[2] = torch.nan
    return errors


@pytest.mark.parametrize("invariance", [0.0, 0.5, 1.0])
def test_depth_losses_equal_their_definition_and_add_up_over_chunks(invariance: float) -> None:
    errors = _errors().requires_grad_()
    expected_l1, expected = 0.0, 0.0
    for image in errors.detach():
        known = [float(e) for e in image.flatten() if not e.isnan()]
        expected_l1 += sum(map(abs, known))
        if known:
            mean_square = sum(e * e for e in known) / len(known)
            # Eigen et al. 2014, equation 4, times the number of pixels.
            eigen = mean_square - invariance * sum(known) ** 2 / len(known) ** 2
            expected += len(known) * eigen
    whole = log_error_sum(errors, "scale_invariant", invariance)
    assert whole.item() == pytest.approx(expected, rel=1e-12)
    assert log_error_sum(errors, "log_l1", invariance).item() == pytest.approx(expected_l1)
    (gradient,) = torch.autograd.grad(whole, errors)
    assert gradient.isfinite().all()
    chunks = [log_error_sum(e, "scale_invariant", invariance) for e in errors[:, None]]
    torch.testing.assert_close(torch.autograd.grad(torch.stack(chunks).sum(), errors)[0], gradient)
