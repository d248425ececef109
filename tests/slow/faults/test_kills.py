"""Runs that are killed; ``python -m tests.slow.faults.kills`` does it at more moments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.slow.faults.kills import campaign, killed_while_writing

if TYPE_CHECKING:
    from pathlib import Path


def test_runs_killed_at_random_moments_end_as_if_nothing_had_happened(
    stanford_root: Path, tmp_path: Path
) -> None:
    outcomes = list(campaign(stanford_root, tmp_path / "runs", moments=4, seed=1))
    assert [len(outcome.steps) for outcome in outcomes] == [1, 2, 1, 2]
    for outcome in outcomes:
        assert not outcome.broken
        assert not outcome.different
    while_writing = killed_while_writing(stanford_root, tmp_path / "runs")
    assert while_writing.left == 1, "half of a checkpoint, under a name that nobody reads"
    assert not while_writing.broken
    assert not while_writing.different
    steps = [outcome.steps[0] for outcome in outcomes]
    assert len(set(steps)) > 1, "not all at the same moment"
