# ruff: noqa: ANN001, ANN202 - Triton looks up what annotations name, and refuses all but its own
"""Label rendering on a GPU: the scores are read once, by one kernel.

It is written in Triton, which torch brings along wherever it knows CUDA. Triton wants a C compiler
the first time; without one, labels are rendered by torch, class by class.
"""

from __future__ import annotations

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

__all__ = ["owner_labels", "usable"]

_BLOCK = 256
"""Pixels of a program."""


@triton.jit  # type: ignore[untyped-decorator]
def _owner_labels(  # type: ignore[no-untyped-def]
    scores, faces, columns, rows, labels, num_pixels, num_classes, dim, block: tl.constexpr
):
    at = tl.program_id(0) * block + tl.arange(0, block)
    there = at < num_pixels
    face = tl.load(faces + at, there, 0).to(tl.int64)
    u = tl.load(columns + at, there, 0.0)
    v = tl.load(rows + at, there, 0.0)
    left = tl.minimum(tl.maximum(tl.floor(u), 0.0), dim - 2.0)
    top = tl.minimum(tl.maximum(tl.floor(v), 0.0), dim - 2.0)
    right = tl.minimum(tl.maximum(u - left, 0.0), 1.0)
    below = tl.minimum(tl.maximum(v - top, 0.0), 1.0)
    above, before = 1.0 - below, 1.0 - right
    size = dim * dim
    corner = scores + face * num_classes * size + top.to(tl.int64) * dim + left.to(tl.int64)
    label = tl.zeros([block], tl.int32)
    best = tl.full([block], float("-inf"), tl.float32)
    for k in range(num_classes):
        score = tl.load(corner, there, 0.0).to(tl.float32) * (above * before)
        score += tl.load(corner + 1, there, 0.0).to(tl.float32) * (above * right)
        score += tl.load(corner + dim, there, 0.0).to(tl.float32) * (below * before)
        score += tl.load(corner + dim + 1, there, 0.0).to(tl.float32) * (below * right)
        score = score.to(scores.dtype.element_ty).to(tl.float32)  # as exact as what is asked for
        larger = score > best  # of equal scores the first, and NaN is never larger
        label = tl.where(larger, k, label)
        best = tl.where(larger, score, best)
        corner += size
    tl.store(labels + at, label.to(labels.dtype.element_ty), there)


def owner_labels(scores: Tensor, face: Tensor, u: Tensor, v: Tensor, labels: Tensor) -> None:
    """Class of the largest bilinear score in the owner's image.

    Args:
        scores: ``(N, K, d, d)``, not float64, contiguous, d ≥ 2.
        face: ``(H, W)`` owners, any integer dtype.
        u: ``(H, W)`` float32 columns in the owners' images.
        v: ``(H, W)`` float32 rows.
        labels: ``(H, W)`` of an unsigned dtype, contiguous, written.
    """
    _, classes, dim, _ = scores.shape
    count = labels.numel()
    on = torch.cuda.device_of(scores)  # type: ignore[no-untyped-call]
    with on:  # Triton takes the current one
        _owner_labels[(triton.cdiv(count, _BLOCK),)](
            *(scores, face, u, v, labels, count, classes, dim, _BLOCK),
            enable_fp_fusion=False,  # as torch computes
        )


@cache
def usable(device: torch.device) -> bool:
    """Whether Triton works on this device: it is asked for labels that are known, once."""
    u = torch.linspace(0, 3, _BLOCK + 1, device=device)[None]
    v = u.flip(1)
    rows, columns = torch.meshgrid(*[torch.arange(4.0, device=device)] * 2, indexing="ij")
    level = torch.full_like(u, 1.4)
    # Scores that are planes: between pixels they are known as well.
    scores = torch.stack([columns, rows, torch.full_like(rows, 1.4)])[None]
    labels = torch.zeros_like(u, dtype=torch.uint8)
    try:
        owner_labels(scores, torch.zeros_like(labels), u, v, labels)
        return torch.equal(labels.long(), torch.stack([u, v, level]).argmax(dim=0))
    except Exception:  # it compiles with what is there: anything may be missing
        return False
