"""Matches, against a slow reference in whole numbers and against OpenCV."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.keypoints import Detector, match

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


def test_opencv_finds_the_same_matches_of_real_descriptors() -> None:
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (300, 400), dtype=np.uint8), (0, 0), 2)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    rotated = cv2.warpAffine(image, cv2.getRotationMatrix2D((200, 150), 20, 0.9), (400, 300))
    left, right = (Detector("sift").detect(view).descriptors for view in (image, rotated))
    assert len(left) > 600  # more than a block
    nearest_two = cv2.BFMatcher(cv2.NORM_L2).knnMatch(left, right, 2)
    expected = [
        [first.queryIdx, first.trainIdx]
        for first, second in nearest_two
        if first.distance < 0.8 * second.distance
    ]
    assert match(left, right, mutual=False).tolist() == expected
    both = [[m.queryIdx, m.trainIdx] for m in cv2.BFMatcher(cv2.NORM_L2, True).match(left, right)]
    assert match(left, right, ratio=1).tolist() == both
