"""Differences between evaluations of the same images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.heads import ClassesHead, DistanceHead
from tangent_train.results.evaluation import (
    EvaluationResult,
    evaluation_result,
    flat_settings,
    write_image_sums,
)
from tangent_train.results.paired import Difference, difference
from tangent_train.results.report import runs_report
from tests.results.example_results import SETTINGS

CLASSES, SHAPE = ("unknown", "a", "b", "c"), (12, 24)
Images = dict[str, NDArray[Any]]


def _evaluated(
    folder: Path, predictions: Images, truths: Images, head: Any = None, **changes: Any
) -> EvaluationResult:
    """The result of an evaluation whose folder has the numbers of each image."""
    head = head or ClassesHead(CLASSES)
    metric = head.build_metric()
    for name, prediction in predictions.items():
        metric.update(torch.from_numpy(prediction), torch.from_numpy(truths[name]))
    counts = metric.compute()
    folder.mkdir()
    write_image_sums(folder, [*predictions], head.image_sums(counts))
    result = evaluation_result(head, counts, "panoramas", len(predictions))
    settings = flat_settings(SETTINGS | {"name": folder.name, "variant": folder.name})
    protocol = {"data": "Rooms", **head.facts, **changes}
    return replace(result, folder=folder, settings=settings, protocol=protocol)


def _truths() -> Images:
    """Six images; class c is in one of them, and some pixels are unknown."""
    rng = np.random.default_rng(2)
    truths = {f"room_{k}": rng.integers(0, 3, SHAPE).astype(np.uint8) for k in range(6)}
    truths["room_3"][:4] = 3
    return truths


def _noisy(truths: Images, share: float, seed: int) -> Images:
    rng = np.random.default_rng(seed)
    return {
        name: np.where(rng.random(SHAPE) < share, rng.integers(1, 4, SHAPE), truth).astype(np.uint8)
        for name, truth in truths.items()
    }


def _miou(predicted: NDArray[Any], truth: NDArray[Any]) -> float:
    known, scores = truth > 0, []
    for label in (1, 2, 3):
        hits = (predicted == label) & (truth == label)
        either = ((predicted == label) | (truth == label)) & known
        if (truth == label).any():
            scores.append(hits.sum() / either.sum())
    return float(np.mean(scores))


def test_equal_evaluations_differ_by_zero(tmp_path: Path) -> None:
    truths = _truths()
    predictions = _noisy(truths, 0.3, 0)
    names = reversed(predictions)
    first = _evaluated(tmp_path / "first", predictions, truths)
    second = _evaluated(tmp_path / "second", {name: predictions[name] for name in names}, truths)
    found = difference(second, first)
    assert isinstance(found, Difference)
    assert found.images == 6
    defined = {name for name, score in first.scores.items() if score is not None}
    assert found.scores.keys() == found.intervals.keys() == defined
    assert {"miou", "seam_step", "boundary_miou"} < defined
    assert set(found.scores.values()) == {0}
    assert set(found.intervals.values()) == {(0, 0)}


def test_a_known_difference(tmp_path: Path) -> None:
    """Every image is alike: of class a a quarter becomes b, which is as large."""
    truths = {str(k): np.ones(SHAPE, np.uint8) for k in range(4)}
    wrong = {}
    for name, truth in truths.items():
        truth[:, 12:] = 2
        wrong[name] = truth.copy()
        wrong[name][:, 6:9] = 2
    results = [_evaluated(tmp_path / str(k), of, truths) for k, of in enumerate((truths, wrong))]
    found = difference(results[1], results[0])
    assert isinstance(found, Difference)
    expected = (3 / 4 + 12 / 15) / 2 - 1
    assert found.scores["miou"] == pytest.approx(expected)
    assert found.scores["macc_solid_angle"] == pytest.approx(-1 / 8)
    assert found.intervals["miou"] == pytest.approx((expected, expected))
    assert found.scores["pole_gap"] == pytest.approx(0)


def test_intervals_equal_a_slow_bootstrap_of_pixels(tmp_path: Path) -> None:
    """In draws without the image of class c, its score is left out of both means."""
    truths = _truths()
    pair = _noisy(truths, 0.2, 1), _noisy(truths, 0.4, 2)
    results = [_evaluated(tmp_path / str(k), of, truths) for k, of in enumerate(pair)]
    found = difference(results[1], results[0])
    times = np.random.default_rng(0).multinomial(6, [1 / 6] * 6, size=1000)
    differences = []
    for counts in times:
        drawn = np.repeat(sorted(truths), counts)
        base, other, true = (np.stack([of[name] for name in drawn]) for of in (*pair, truths))
        differences.append(_miou(other, true) - _miou(base, true))
    low, high = np.percentile(differences, [2.5, 97.5])
    assert isinstance(found, Difference)
    assert found.intervals["miou"] == pytest.approx((low, high))
    assert found.scores["miou"] == pytest.approx(
        results[1].scores["miou"] - results[0].scores["miou"]  # type: ignore[operator]
    )
    widths = [high - low for low, high in (r.intervals["miou"] for r in results)]
    assert high - low < max(widths), "paired"


def test_distances_of_images_without_truth_are_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truths = {str(k): rng.uniform(1, 5, SHAPE) for k in range(5)}
    truths["4"][:] = np.nan
    factors = rng.uniform(1, 1.3, (2, 5))
    results = [
        _evaluated(
            tmp_path / str(k),
            {name: truths[name] * f for name, f in zip(truths, of, strict=True)},
            truths,
            DistanceHead(depth_kind="metric_distance"),
        )
        for k, of in enumerate(factors)
    ]
    found = difference(results[1], results[0])
    times = np.random.default_rng(0).multinomial(5, [1 / 5] * 5, size=1000)[:, :4]
    each = factors[1, :4] - factors[0, :4]
    drawn = [counts @ each / counts.sum() for counts in times if counts.sum()]
    assert isinstance(found, Difference)
    assert found.scores["absrel"] == pytest.approx(each.mean())
    assert found.intervals["absrel"] == pytest.approx(np.percentile(drawn, [2.5, 97.5]))
    assert found.scores["seam_step"] == pytest.approx(0, abs=1e-9)


def test_only_common_images_count_and_reasons_are_named(tmp_path: Path) -> None:
    truths = _truths()
    some = [*truths][1:5]
    first = _evaluated(tmp_path / "first", {name: truths[name] for name in some}, truths)
    second = _evaluated(tmp_path / "second", _noisy(truths, 0.3, 0), truths)
    others = {f"hall_{k}": truth for k, truth in enumerate(truths.values())}
    results = [
        first,
        second,
        _evaluated(tmp_path / "others", others, others),
        _evaluated(tmp_path / "zero", truths, truths, absent_class="zero"),
        replace(first, folder=tmp_path / "old", settings={**first.settings, "variant": "old"}),
    ]
    report = runs_report(results)
    table = report.differences()
    cells: dict[str, str] = dict(map(tuple, table.rows))  # type: ignore[arg-type]
    common = {name: _noisy(truths, 0.3, 0)[name] for name in some}
    stacked = [np.stack([of[name] for name in some]) for of in (common, truths)]
    assert table.title == "Difference from first (variant=first)"
    assert table.header == ("", "second")
    assert cells["panoramas of both"] == "4"
    assert cells["mIoU %"].startswith(f"{100 * (_miou(*stacked) - 1):.1f} [-")
    assert report.notes == [
        f"{label}: no difference from first (variant=first): {reason}."
        for label, reason in (
            ("others", "no image in common"),
            ("zero", "their absent_class differs"),
            ("first (variant=old)", "results.npz is missing: evaluate again"),
        )
    ]
    (line,) = (
        line
        for line in report.csv_lines()
        if (line["row"], line["score"], line["fold"], line["class"], line["south"])
        == ("second", "miou", "mean", "mean", None)
    )
    assert line["difference_images"] == 4
    assert line["difference_low"] < line["difference"] < line["difference_high"] < 0
