"""Matches, against a slow reference in whole numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.keypoints import match


def reference(
    left: NDArray[np.float32], right: NDArray[np.float32], ratio: float, mutual: bool
) -> list[list[int]]:
    """One pair after the other, in whole numbers and float64."""
    table = [[float(((one.astype(float) - two) ** 2).sum()) for two in right] for one in left]
    pairs = []
    for i, row in enumerate(table):
        order = sorted(range(len(row)), key=lambda j, row=row: (row[j], j))  # type: ignore[misc]
        second = row[order[1]] if len(row) > 1 else float("inf")
        if ratio < 1 and not row[order[0]] < ratio**2 * second:
            continue
        column = [other[order[0]] for other in table]
        if mutual and column.index(min(column)) != i:
            continue
        pairs.append([i, order[0]])
    return pairs


@example(1300, 5, 0.8, False, 3)  # more than a block
@given(
    *(st.integers(0, 9), st.integers(0, 9), st.sampled_from([0.5, 0.8, 1.0, 1.5])),
    *(st.booleans(), st.integers(0, 2**32 - 1)),
)
@settings(max_examples=150, deadline=None)
def test_matches_are_those_of_the_definition(
    n: int, m: int, ratio: float, mutual: bool, seed: int
) -> None:
    """Few values in few dimensions: equal distances all over, where the first counts."""
    rng = np.random.default_rng(seed)
    largest = 2 if seed % 2 else 256
    left, right = (rng.integers(0, largest, (k, 3)).astype(np.float32) for k in (n, m))
    expected = reference(left, right, ratio, mutual) if n and m else []
    assert match(left, right, ratio, mutual=mutual).tolist() == expected
