"""Which class takes most from the mean IoU."""

from __future__ import annotations

from collections.abc import Sequence

from tangent_train.tasks.reports.cells import percent
from tangent_train.tasks.reports.groups import Group
from tangent_train.tasks.reports.runs import Run

__all__ = ["is_labelled", "largest_losses"]


def is_labelled(run: Run, class_index: int) -> bool:
    """Whether a class has labelled pixels: ``absent_class=zero`` counts others as 0."""
    return bool(run.results["classes"][class_index].get("share", 1))


def largest_losses(groups: Sequence[Group]) -> list[str]:
    """For every group the class that takes most from its mean IoU.

    Args:
        groups: From `groups.group_runs`.

    Returns:
        A sentence per group, none for groups without labelled classes.
    """
    sentences = []
    for group in groups:
        ious = [
            (mean, name)
            for k, name in enumerate(group.class_names)
            if any(is_labelled(run, k) for run in group.runs)
            and (mean := group.figure("iou", k).mean) is not None
        ]
        if ious:
            iou, name = min(ious, key=lambda found: found[0])
            sentences.append(f"{group.label}: largest loss: {name}, {percent(iou)} % IoU.")
    return sentences
