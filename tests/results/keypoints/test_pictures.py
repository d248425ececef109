"""Pictures of matches: where lines begin and end, across the seam as well."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.results.keypoints.pictures import DrawnMatches, matches_picture

HEAD, GAP = 26, 4
PALE = 128 // 2 + 96


def _grey(rows: int) -> NDArray[np.uint8]:
    return np.full((rows, 2 * rows, 3), 128, np.uint8)


def _drawn(
    left: tuple[float, float], right: tuple[float, float], *, inlier: bool = True
) -> DrawnMatches:
    return DrawnMatches(np.array([left]), np.array([right]), np.array([inlier]))


def _columns_of_color(row: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Columns of a row whose colour is not grey."""
    spread = row.astype(int).max(axis=-1) - row.astype(int).min(axis=-1)
    return np.flatnonzero(spread > 60)


def test_a_line_joins_both_keypoints() -> None:
    picture = matches_picture(
        _grey(100), _grey(100), {"L0": _drawn((50, 40), (90, 60))}, columns=200
    )
    assert picture.shape == (HEAD + 200 + GAP + GAP, 200 + GAP, 3)
    assert 50 in _columns_of_color(picture[HEAD + 40])
    lower = HEAD + 100 + GAP + 60
    assert 90 in _columns_of_color(picture[lower])
    middle = _columns_of_color(picture[HEAD + 102])
    assert abs(middle.mean() - (50 + 40 * 62 / 124)) < 2
    assert not len(_columns_of_color(picture[HEAD + 30]))
    assert not len(_columns_of_color(picture[lower + 10]))


def test_the_shorter_way_goes_across_the_seam() -> None:
    picture = matches_picture(
        _grey(100), _grey(100), {"L0": _drawn((10, 50), (190, 50))}, columns=200
    )
    # From column 10 to the left: −10 half way down, so out at 0 and in again at 200.
    assert abs(_columns_of_color(picture[HEAD + 50 + 26]).mean() - 5) < 3
    assert abs(_columns_of_color(picture[HEAD + 50 + 78]).mean() - 195) < 3
    for row in range(HEAD + 55, HEAD + 150):
        columns = _columns_of_color(picture[row])
        assert ((columns < 13) | (columns > 187)).all()


def test_panoramas_are_scaled_with_their_keypoints() -> None:
    picture = matches_picture(
        _grey(50), _grey(200), {"L0": _drawn((25, 20), (180, 120))}, columns=200
    )
    # Pixel centres: (25 + ½) · 2 − ½ = 50.5, (20 + ½) · 2 − ½ = 40.5; (180 + ½) / 2 − ½ = 89.75.
    assert abs(_columns_of_color(picture[HEAD + 40]).mean() - 50.5) < 3
    assert 90 in _columns_of_color(picture[HEAD + 100 + GAP + 60])


def test_other_matches_are_dots_without_lines() -> None:
    picture = matches_picture(
        _grey(100), _grey(100), {"L0": _drawn((50, 40), (90, 60), inlier=False)}, columns=200
    )
    red = picture[HEAD + 40, 50].astype(int)
    assert red[0] > red[1] + 60
    assert not len(_columns_of_color(picture[HEAD + 80]))
    assert 90 in _columns_of_color(picture[HEAD + 100 + GAP + 60])


@pytest.mark.parametrize(
    ("count", "across", "down"), [(1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 2, 2), (5, 3, 2)]
)
def test_panels_are_arranged_in_rows(count: int, across: int, down: int) -> None:
    panels = {f"L{k}": _drawn((5, 5), (9, 9)) for k in range(count)}
    picture = matches_picture(_grey(20), _grey(20), panels, columns=80)
    panel = HEAD + 40 + GAP + 40 + GAP
    assert picture.shape == (down * panel, across * (80 + GAP), 3)
    # Panels that are not needed are white.
    assert (picture[-GAP - 10, -GAP - 10] == 255).all() == (count < across * down)


def test_no_matches_and_many() -> None:
    none = DrawnMatches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.bool_))
    empty = matches_picture(_grey(20), _grey(20), {"L0": none}, columns=40)
    assert (empty[HEAD : HEAD + 20, :40] == PALE).all()
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 38, (2, 5000, 2)) * (1, 0.5)
    many = DrawnMatches(places[0], places[1], np.ones(5000, np.bool_))
    first, again = (matches_picture(_grey(20), _grey(20), {"L0": many}) for _ in range(2))
    np.testing.assert_array_equal(first, again)
