"""Which class takes most from the mean over the classes."""

from __future__ import annotations

from collections.abc import Sequence

from tangent_train.results.reports.cells import percent
from tangent_train.results.reports.groups import Group
from tangent_train.results.reports.runs import FIGURES, Run

__all__ = ["is_labelled", "largest_losses"]


_UNITS = {"iou": "IoU", "accuracy": "accuracy"}


def is_labelled(run: Run, class_index: int) -> bool:
    """Whether a class has labelled pixels: ``absent_class=zero`` counts others as 0."""
    return bool(run.results["classes"][class_index].get("share", 1))


def largest_losses(groups: Sequence[Group]) -> list[str]:
    """For every group the class that takes most from its mean IoU, or accuracy of shapes.

    Args:
        groups: From `groups.group_runs`.

    Returns:
        A sentence per group, none for groups without labelled classes.
    """
    sentences = []
    for group in groups:
        figure = FIGURES[group.kind].worst
        found = [
            (mean, name)
            for k, name in enumerate(group.class_names)
            if any(is_labelled(run, k) for run in group.runs)
            and (mean := group.figure(figure, k).mean) is not None
        ]
        if found:
            worst, name = min(found, key=lambda pair: pair[0])
            sentences.append(
                f"{group.label}: largest loss: {name}, {percent(worst)} % {_UNITS[figure]}."
            )
    return sentences
