"""Learning rate schedules: which of them were made for one length of training."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import torch


def ends_at(epochs: int, make_optimizer: Callable[..., Any], make_scheduler: Any) -> bool:
    """Return True if a schedule was made for a number of epochs, whatever its settings are called.

    Its learning rate then changes in every epoch up to the last one or the one after it, and from
    there on it stays, or turns back.

    Args:
        epochs: Number of epochs; negative for a training without an end.
        make_optimizer: Makes the optimizer from parameters.
        make_scheduler: Makes the scheduler, stepped every epoch, from the optimizer.
    """
    optimizer = make_optimizer([{"params": [torch.zeros(1, requires_grad=True)]}])
    scheduler = make_scheduler(optimizer)
    rates = [optimizer.param_groups[0]["lr"]]
    for _ in range(2 * epochs + 1):
        optimizer.step(lambda: 0.0)  # some optimizers need a closure
        scheduler.step()
        rates.append(optimizer.param_groups[0]["lr"])
    changes = [after - before for before, after in itertools.pairwise(rates)]
    return any(
        all(changes[max(end - 2, 0) : end])
        and (not any(changes[end:]) or changes[end - 1] * changes[end] < 0)
        for end in (epochs - 1, epochs)
        if end > 0
    )
