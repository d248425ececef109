"""Matches, against a slow reference in whole numbers."""

from __future__ import annotations

from typing import Literal

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.keypoints import match

Norm = Literal["l2", "hamming"]


def reference(
    left: NDArray[np.generic], right: NDArray[np.generic], norm: Norm, ratio: float, mutual: bool
) -> list[list[int]]:
    """One pair after the other, in whole numbers and float64."""
    if norm == "hamming":
        left, right = (np.unpackbits(a.view(np.uint8), axis=1) for a in (left, right))
    table = [[float(((one.astype(float) - two) ** 2).sum()) for two in right] for one in left]
    share = ratio if norm == "hamming" else ratio**2
    pairs = []
    for i, row in enumerate(table):
        order = sorted(range(len(row)), key=lambda j, row=row: (row[j], j))  # type: ignore[misc]
        second = row[order[1]] if len(row) > 1 else float("inf")
        if ratio < 1 and not row[order[0]] < share * second:
            continue
        column = [other[order[0]] for other in table]
        if mutual and column.index(min(column)) != i:
            continue
        pairs.append([i, order[0]])
    return pairs


@example(1300, 5, "l2", 0.8, False, 3)  # more than a block
@given(
    st.integers(0, 9),
    st.integers(0, 9),
    st.sampled_from(["l2", "hamming"]),
    st.sampled_from([0.5, 0.8, 1.0, 1.5]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=150, deadline=None)
def test_matches_are_those_of_the_definition(
    n: int, m: int, norm: Norm, ratio: float, mutual: bool, seed: int
) -> None:
    """Few values in few dimensions: equal distances all over, where the first counts."""
    rng = np.random.default_rng(seed)
    left, right = (rng.integers(0, 2 if seed % 2 else 256, (k, 3), np.uint8) for k in (n, m))
    if norm == "l2":
        left, right = left.astype(np.float32), right.astype(np.float32)
    expected = reference(left, right, norm, ratio, mutual) if n and m else []
    assert match(left, right, norm, ratio, mutual=mutual).tolist() == expected
