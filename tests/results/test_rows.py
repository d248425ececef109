"""Means over folds and seeds, and ratios, against figures worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tangent_train.errors import DataError
from tangent_train.results.evaluation import EvaluationResult
from tangent_train.results.rows import RunRow, check_alike, group_results
from tests.results.example_results import example_result, without_solid_angle


@pytest.fixture
def three_folds() -> list[EvaluationResult]:
    """Folds 1 (three seeds), 2 (one), 3 (two, without sofas)."""
    return [
        *(
            example_result([wall, 0.5, 0.5], seed=seed, data__fold=1)
            for seed, wall in enumerate((0.1, 0.2, 0.6))
        ),
        example_result([0.6, 0.8, 0.7], data__fold=2),
        *(
            example_result([wall, 0.2, None], data__fold=3, seed=seed, data__root="/other")
            for seed, wall in enumerate((0.8, 1.0))
        ),
    ]


def test_seeds_are_averaged_within_folds_and_then_the_folds(
    three_folds: list[EvaluationResult],
) -> None:
    row = RunRow.of("", three_folds[::-1], {})
    assert row.folds == (1, 2, 3)
    wall = row.score("iou", "wall")
    # Folds: (0.1 + 0.2 + 0.6) / 3 = 0.3, 0.6, 0.9. Not the mean of the six runs, 0.55.
    assert wall.mean == pytest.approx(0.6)
    assert wall.over_folds == pytest.approx(0.3)
    # Squares within folds: 0.04 + 0.01 + 0.09 and 0.01 + 0.01, over 2 + 1 degrees of freedom.
    assert wall.over_seeds == pytest.approx((0.16 / 3) ** 0.5)
    assert wall.folds == 3


@pytest.mark.parametrize("name", ["miou", "miou_solid_angle"])
def test_the_ratio_is_that_of_the_means_over_shared_runs(name: str) -> None:
    """Panoramas compared with photos, two folds of two seeds."""
    photos = {(2, 0): 0.8, (1, 0): 0.4, (1, 1): 0.6, (2, 1): 0.8, (3, 0): 0.1}
    sphere = {(1, 1): 0.5, (1, 0): 0.3, (2, 1): 0.7, (2, 0): 0.9, (3, 1): 0.9}
    before, after = (
        [example_result([v] * 3, data__fold=f, seed=s) for (f, s), v in values.items()]
        for values in (photos, sphere)
    )
    partner = RunRow.of("P", map(without_solid_angle, before), {})
    row = replace(RunRow.of("S", after, {}), partner=partner)
    # Folds 1 and 2: 0.4 and 0.8 of 0.5 and 0.8; fold 3 has other seeds.
    assert row.ratio(name) == pytest.approx(0.6 / 0.65)
    assert row.ratio(name, fold=1) == pytest.approx(0.8)


def test_other_settings_make_other_groups_named_by_what_differs() -> None:
    records = [
        example_result([0.1, 0.2, 0.3], optimizer__lr=rate, data__fold=fold)
        for rate, fold in [(0.01, 1), (0.01, 2), (0.02, 1), (0.02, 2)]
    ]
    # As of tangent-evaluate: null is what is not there.
    records[1] = replace(records[1], settings={**records[1].settings, "label_map": None})
    records.append(example_result([0.1, 0.2, 0.3], name="other", optimizer__lr=0.03))
    assert [(label, len(group)) for label, group in group_results(records).items()] == [
        ("mine (optimizer.lr=0.01)", 2),
        ("mine (optimizer.lr=0.02)", 2),
        ("other", 1),
    ]


def test_groups_have_different_names_however_many_settings_differ() -> None:
    stopping = {"_target_": "EarlyStopping", "patience": 3, "min_delta": 0.1, "mode": "max"}
    records = [
        example_result([0.1, 0.2, 0.3], callbacks__early_stopping=stopping),
        example_result([0.1, 0.2, 0.3], optimizer__lr=0.02, level=6),
        example_result([0.1, 0.2, 0.3], optimizer__lr=0.02, level=6, scheduler__gamma=0.5),
        example_result([0.1, 0.2, 0.3], optimizer__lr=0.02, level=6, scheduler__gamma=0.6),
    ]
    labels = [*group_results(records)]
    assert len(set(labels)) == 4
    assert labels[1].startswith("mine (callbacks.early_stopping=None, level=6, optimizer.lr=0.02, ")
    assert "patience" not in "".join(labels)


def test_runs_with_other_classes_are_refused() -> None:
    records = [
        example_result([0.1, 0.2, 0.3]),
        example_result([0.1, 0.2], ("wall", "road"), data__fold=2),
    ]
    with pytest.raises(DataError, match=r"2_0/results\.json: .*wall, road.*1_0/results\.json"):
        check_alike(records)
