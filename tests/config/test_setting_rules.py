"""Settings that may differ between runs."""

from __future__ import annotations

import pytest

from tangent_train.config.setting_rules import Purpose, differing_settings, from_file, may_differ


@pytest.mark.parametrize(
    ("name", "purposes"),
    [
        ("task.compile.mode", {"resume", "report", "transfer", "evaluation"}),
        ("seed", {"report"}),
        ("trainer.max_epochs", {"resume", "evaluation"}),
        ("trainer.precision", set()),
        ("optimizer.lr", {"evaluation"}),
        ("init_from", {"resume", "transfer", "evaluation"}),
        ("rooted", set()),
    ],
)
def test_purposes_for_which_a_setting_may_differ(name: str, purposes: set[Purpose]) -> None:
    every: tuple[Purpose, ...] = ("resume", "report", "transfer", "evaluation")
    assert {purpose for purpose in every if may_differ(name, purpose)} == purposes


def test_differences_are_found_in_nested_and_missing_settings() -> None:
    before = {"data": {"root": "a", "fold": 1}, "network": {"x": 1}, "trainer": {"devices": 1}}
    now = {"data": {"root": "b", "fold": 2}, "network": {"y": 2}, "trainer": {"devices": 2}}
    assert differing_settings(now, before, "resume") == [
        ("data.fold", 2, 1), ("network.x", None, 1), ("network.y", 2, None)
    ]  # fmt: skip


def test_a_mask_may_lie_elsewhere_when_a_run_is_resumed() -> None:
    path, other, latitude = ({"data": {"mask": mask}} for mask in ("a.png", "/b.png", -60))
    assert differing_settings(other, path, "resume") == []
    assert differing_settings(other, path, "report") == [("data.mask", "/b.png", "a.png")]
    assert differing_settings(path, latitude, "resume") == [("data.mask", "a.png", -60)]
    assert [from_file("data.mask", mask) for mask in (-60, None, "a.png")] == [True, True, False]
