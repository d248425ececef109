"""The pictures of a transfer: bars, lines and marks where the figures are."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from tangent_train.results.reports.paper import CLASSES
from tangent_train.results.transfer.chart import levels_png, transfer_png
from tangent_train.results.transfer.report import gather
from tests.results.transfer.transfer_runs import REAL, both, levels, make_run, stage

BLUE = (0xB2, 0x72, 0x00)  # OpenCV's order
GREY = (0x99, 0x99, 0x99)


def decoded(png: bytes) -> Any:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def tallest(picture: Any, color: tuple[int, int, int]) -> int:
    """Rows of the tallest area of a colour."""
    areas = (picture == color).all(-1).astype(np.uint8)
    return int(cv2.connectedComponentsWithStats(areas)[2][1:, cv2.CC_STAT_HEIGHT].max())


def test_bars_have_the_right_height() -> None:
    """Photos are grey, tangent images blue; bars of classes are not as tall."""

    def heights(sphere: float) -> tuple[int, int]:
        results = [stage("P", make_run(0.4)), stage("S", make_run(sphere))]
        picture = decoded(transfer_png(gather(results)))
        accuracy = picture[:, picture.shape[1] // 2 :]
        return tallest(accuracy, GREY), tallest(accuracy, BLUE)

    # mAcc is 0.1 higher.
    (photos, low), (again, high) = heights(0.2), heights(0.8)
    assert photos == again > 100
    assert high / low == pytest.approx(3, abs=0.1)
    assert photos / low == pytest.approx(5 / 3, abs=0.05)


def test_every_mark_changes_the_picture() -> None:
    """Seeds (error bars), folds (dots), the paper's figures (diamonds), bands (lines)."""
    one = decoded(transfer_png(gather(both({(1, 0): 0.5}, {(1, 0): 0.4}))))
    seeds = decoded(
        transfer_png(gather(both({(1, 0): 0.5, (1, 1): 0.5}, {(1, 0): 0.3, (1, 1): 0.5})))
    )
    folds = decoded(
        transfer_png(gather(both({(1, 0): 0.5, (2, 0): 0.5}, {(1, 0): 0.3, (2, 0): 0.5})))
    )
    unbanded = [stage("P", make_run(0.5)), stage("S", make_run(0.4))]
    assert decoded(transfer_png(gather(unbanded))).shape[0] < one.shape[0]
    for other in (seeds, folds):
        assert other.shape == one.shape
        # The means are the same; below the title only the marks differ.
        title = one.shape[0] // 20
        assert 20 < (other[title:] != one[title:]).any(-1).sum() < 5000
    assert decoded(transfer_png(gather(both({(1, 0): 0.5}, {(1, 0): 0.4})))).tobytes() == (
        one.tobytes()
    )


def test_the_papers_figures_are_marked() -> None:
    """On photos above the bars, on panoramas within: 47.4, 45.3; 61.7, 60.2 %."""

    def picture(target: str) -> Any:
        settings = {"data._target_": target}
        runs = [make_run(share, names=CLASSES, settings=settings) for share in (0.2, 0.85)]
        return decoded(transfer_png(gather([stage("P", runs[0]), stage("S", runs[1])])))

    real, other = picture(REAL), picture("my.Data")
    title = real.shape[0] // 20
    changed = (real[title:] != other[title:]).any(-1).astype(np.uint8)
    _, _, boxes, centres = cv2.connectedComponentsWithStats(changed, connectivity=8)
    assert (boxes[1:, 2] == boxes[1:, 3]).all()
    heights = centres[1:, 1][np.argsort(centres[1:, 0])]
    assert len(heights) == 4
    miou, macc = heights[:2], heights[2:]
    percent = (miou - macc) / np.array([61.7 - 47.4, 60.2 - 45.3])
    assert percent[0] == pytest.approx(percent[1], rel=0.02)
    assert (miou[1] - miou[0]) / percent[0] == pytest.approx(47.4 - 45.3, abs=0.2)


def test_many_stages_of_any_representation_are_drawn() -> None:
    ways = ("erp", "cubemap", "fisheye", "mine")
    results = [stage("P", make_run(0.4)), stage("S", make_run(0.3, bands=(0.2, None)))]
    results += [stage(f"S {way}", make_run(0.3), representation=way) for way in ways]
    results += [stage(f"S-FT-{k}", make_run(0.5, bands=(0.2, 0.3))) for k in (1, 2, 3, 4, 5)]
    assert decoded(transfer_png(gather(results))).shape[1] > 1000


def test_photos_without_panoramas_are_drawn() -> None:
    assert decoded(transfer_png(gather([stage("P", make_run(0.4, photos=True))]))).any()


def test_the_level_of_training_is_a_vertical_line() -> None:
    figures = {(level, 1, 0): 0.5 for level in (6, 7, 8, 9)}

    def column(trained: float) -> int:
        picture = decoded(levels_png(levels(figures, trained)))
        dark = (picture == 0x33).all(-1)
        return int(dark.sum(0).argmax())

    first, between, last = column(7.0), column(7.5), column(9.0)
    assert between - first == pytest.approx((last - first) / 4, abs=2)
    assert last - first > 300


def test_the_lines_of_levels_follow_the_figures_and_show_spreads() -> None:
    def picture(*seeds: float) -> Any:
        figures = {(level, 1, k): seed for level in (7, 8) for k, seed in enumerate(seeds)}
        return decoded(levels_png(levels(figures, 7.5)))

    def height(found: Any) -> float:
        return float(np.nonzero((found == BLUE).all(-1).sum(1) > 300)[0].mean())

    low, high = picture(0.2), picture(0.6)
    assert height(low) - height(high) == pytest.approx(0.4 / 1.05 * 490, rel=0.1)
    spread = picture(0.5, 0.7)
    assert height(spread) == pytest.approx(height(high), abs=1)
    assert (spread != high).any()


def test_folds_are_faint_lines() -> None:
    means = {(level, fold, 0): 0.5 for level in (7, 8) for fold in (1, 2)}
    apart = {key: 0.3 if key[1] == 1 else 0.7 for key in means}
    one, two = decoded(levels_png(levels(means, 7.0))), decoded(levels_png(levels(apart, 7.0)))
    assert (one != two).any(-1).sum() > 500
