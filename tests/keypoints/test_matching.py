"""Matches, against a slow reference in whole numbers and against OpenCV."""

from __future__ import annotations

import tracemalloc
from typing import Literal

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.keypoints.detectors import Detector
from tangent_train.keypoints.matching import match

Norm = Literal["l2", "hamming"]


def sift_like(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    return rng.integers(0, 256, (count, 128)).astype(np.float32)


def distances(
    left: NDArray[np.generic], right: NDArray[np.generic], norm: Norm
) -> list[list[float]]:
    """One pair after the other, in Python's whole numbers and float64."""
    if norm == "hamming":
        return [
            [sum(int(a ^ b).bit_count() for a, b in zip(one, two, strict=True)) for two in right]
            for one in left
        ]
    return [[float(np.linalg.norm(one.astype(float) - two)) for two in right] for one in left]


def reference(
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    norm: Norm,
    ratio: float,
    mutual: bool,
) -> list[list[int]]:
    table = distances(left, right, norm)
    pairs = []
    for i, row in enumerate(table):
        order = sorted(range(len(row)), key=lambda j, row=row: (row[j], j))  # type: ignore[misc]
        second = row[order[1]] if len(row) > 1 else float("inf")
        if ratio < 1 and not row[order[0]] < ratio * second:
            continue
        column = [other[order[0]] for other in table]
        if mutual and column.index(min(column)) != i:
            continue
        pairs.append([i, order[0]])
    return pairs


def noisy_copies(
    rng: np.random.Generator, n_left: int, n_right: int, norm: Norm
) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """Right descriptors like some left ones, with exact duplicates on both sides."""
    left = rng.integers(0, 256, (n_left, 32 if norm == "hamming" else 128), dtype=np.uint8)
    left[-5:] = left[:5]
    right = left[rng.integers(0, n_left, n_right)]
    if norm == "hamming":
        flips = np.full(right.shape, 255, np.uint8)
        for _ in range(4):  # one bit in sixteen stays set
            flips &= rng.integers(0, 256, right.shape, dtype=np.uint8)
        right ^= flips
    else:
        noise = rng.integers(-90, 91, right.shape)
        right = np.clip(right.astype(np.int64) + noise, 0, 255).astype(np.uint8)
    right[-5:] = right[0]
    if norm == "hamming":
        return left, right
    return left.astype(np.float32), right.astype(np.float32)


@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.97, 1.0])
@pytest.mark.parametrize("norm", ["l2", "hamming"])
def test_matches_are_those_of_the_definition(norm: Norm, ratio: float, mutual: bool) -> None:
    left, right = noisy_copies(np.random.default_rng(1), 61, 47, norm)
    expected = reference(left, right, norm, ratio, mutual)
    found = match(left, right, norm, ratio, mutual=mutual)
    assert found.dtype == np.int64
    assert found.tolist() == expected
    assert 5 < len(expected) < 61 or not mutual  # the case says something


@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.sampled_from([0.5, 0.8, 1.0, 1.5]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_ties_go_to_the_first(n: int, m: int, ratio: float, mutual: bool, seed: int) -> None:
    # Few values in few dimensions: equal distances all over.
    rng = np.random.default_rng(seed)
    left, right = (rng.integers(0, 2, (k, 3)).astype(np.float32) for k in (n, m))
    expected = reference(left, right, "l2", ratio, mutual)
    assert match(left, right, "l2", ratio, mutual=mutual).tolist() == expected


def test_blocks_of_any_size_are_put_together_rightly() -> None:
    # More rows and more columns than a block has, and not a multiple of it.
    rng = np.random.default_rng(2)
    left, right = (rng.integers(0, 256, (n, 8)).astype(np.float32) for n in (1300, 9001))
    found = match(left, right, ratio=1, mutual=False)
    exact = [
        int(np.argmin(((right.astype(np.int64) - row) ** 2).sum(axis=1)))
        for row in left.astype(np.int64)
    ]
    np.testing.assert_array_equal(found, np.stack([np.arange(1300), exact], axis=1))
    back = match(right, left, ratio=1, mutual=False)[:, 1]
    expected = [(i, j) for i, j in enumerate(exact) if back[j] == i]
    np.testing.assert_array_equal(match(left, right, ratio=1), expected)


def test_opencv_finds_the_same_matches_of_real_descriptors() -> None:
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (200, 300), dtype=np.uint8), (0, 0), 2)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    turned = cv2.warpAffine(image, cv2.getRotationMatrix2D((150, 100), 20, 0.9), (300, 200))
    left, right = (Detector("sift").detect(view).descriptors for view in (image, turned))
    nearest_two = cv2.BFMatcher(cv2.NORM_L2).knnMatch(left, right, 2)
    for ratio in (0.75, 0.8, 0.9):
        expected = [
            [first.queryIdx, first.trainIdx]
            for first, second in nearest_two
            if first.distance < ratio * second.distance
        ]
        assert len(expected) > 50
        assert match(left, right, ratio=ratio, mutual=False).tolist() == expected
    both = [[m.queryIdx, m.trainIdx] for m in cv2.BFMatcher(cv2.NORM_L2, True).match(left, right)]
    assert match(left, right, ratio=1).tolist() == both


def test_opencv_finds_the_same_matches_of_bits() -> None:
    left, right = noisy_copies(np.random.default_rng(4), 300, 280, "hamming")
    both = cv2.BFMatcher(cv2.NORM_HAMMING, True).match(left, right)
    # OpenCV may take another of equals: only what is unique can be compared.
    bits = [np.unpackbits(array.view(np.uint8), axis=1).astype(int) for array in (left, right)]
    table = (bits[0][:, None] != bits[1][None]).sum(axis=2)
    unique = [
        [m.queryIdx, m.trainIdx]
        for m in both
        if (table[m.queryIdx] == m.distance).sum()
        == (table[:, m.trainIdx] == m.distance).sum()
        == 1
    ]
    found = match(left, right, "hamming", ratio=1).tolist()
    assert len(unique) > 50
    assert all(pair in found for pair in unique)


def test_near_equals_of_descriptors_that_are_no_whole_numbers() -> None:
    # Scalar products in float32 would not tell these two apart: they differ by 1e-6 in length 10.
    rng = np.random.default_rng(5)
    base = rng.normal(size=(1, 64)).astype(np.float32)
    base *= 10 / np.linalg.norm(base)
    right = np.concatenate([base + 3e-6, base + 1e-6, -base]).astype(np.float32)
    expected = reference(base, right, "l2", 0.8, mutual=True)
    assert match(base, right).tolist() == expected == [[0, 1]]


@pytest.mark.parametrize("norm", ["l2", "hamming"])
@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0)])
def test_nothing_matches_nothing(norm: Norm, n: int, m: int) -> None:
    found = match(np.zeros((n, 32), np.uint8), np.zeros((m, 32), np.uint8), norm)
    assert found.shape == (0, 2)
    assert found.dtype == np.int64


def test_a_single_descriptor_has_no_rival() -> None:
    rng = np.random.default_rng(6)
    left, right = sift_like(rng, 5), sift_like(rng, 1)
    right[0] = left[3]
    assert match(left, right).tolist() == [[3, 0]]
    assert match(right, left).tolist() == [[0, 3]]
    assert match(left, right, mutual=False).tolist() == [[i, 0] for i in range(5)]


def test_duplicates_on_the_right_are_not_clear() -> None:
    rng = np.random.default_rng(7)
    left = sift_like(rng, 1)
    assert match(left, np.repeat(left, 2, axis=0)).tolist() == []
    assert match(left, np.repeat(left, 2, axis=0), ratio=1).tolist() == [[0, 0]]


def test_memory_does_not_grow_with_the_product() -> None:
    rng = np.random.default_rng(8)
    left, right = sift_like(rng, 6000), sift_like(rng, 6000)
    tracemalloc.start()
    match(left, right)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40e6  # all distances would be 144 MB in float32


@pytest.mark.parametrize(
    ("left", "right", "norm", "ratio", "message"),
    [
        (np.zeros((2, 4)), np.zeros((2, 5)), "l2", 0.8, r"\(2, 4\) and \(2, 5\)"),
        (np.zeros(4), np.zeros((2, 4)), "l2", 0.8, r"\(4,\) and \(2, 4\)"),
        (np.full((2, 4), np.nan), np.zeros((2, 4)), "l2", 0.8, "no numbers"),
        (np.zeros((2, 4), np.complex64), np.zeros((2, 4)), "l2", 0.8, "no numbers"),
        (np.zeros((2, 4), np.float32), np.zeros((2, 4)), "hamming", 0.8, "float32 descriptors"),
        (np.zeros((2, 4)), np.zeros((2, 4)), "l1", 0.8, "l2 or hamming"),
        (np.zeros((2, 4)), np.zeros((2, 4)), "l2", 0.0, "ratio: found 0.0"),
        (np.zeros((2, 4)), np.zeros((2, 4)), "l2", float("nan"), "ratio: found nan"),
    ],
)
def test_what_cannot_be_matched(
    left: NDArray[np.generic], right: NDArray[np.generic], norm: Norm, ratio: float, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        match(left, right, norm, ratio)
