"""Running parts of a network more than once, as if it had been once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

__all__ = ["KeptStatistics", "joined", "recomputed", "same_draws", "seeds"]


class KeptStatistics:
    """A context in which batch normalization does not add to its running statistics.

    It still normalizes by those of its batch. It can be entered again and again.

    Args:
        network: Whose layers.
    """

    def __init__(self, network: nn.Module) -> None:
        self._network = network
        self._paused: list[tuple[Any, Any, Any]] = []

    def __enter__(self) -> None:
        """Pause all that would."""
        self._paused = [
            (module, module.momentum, module.num_batches_tracked)
            for module in self._network.modules()
            if module.training and getattr(module, "track_running_stats", False)
        ]
        # The statistics stay where they are: what a gradient needs is the same in both contexts.
        for module, _, batches in self._paused:
            module.momentum = 0.0
            module.num_batches_tracked = None if batches is None else torch.zeros_like(batches)

    def __exit__(self, *_: object) -> None:
        """Let them go on."""
        for module, momentum, batches in self._paused:
            module.momentum, module.num_batches_tracked = momentum, batches


def recomputed(
    function: Callable[..., Any],
    *arguments: Any,
    first: AbstractContextManager[object],
    again: AbstractContextManager[object],
) -> Any:
    """Call a function without keeping what its gradient needs, which the backward pass recomputes.

    Args:
        function: Its result must not depend on anything but these arguments and parameters;
            randomness must be seeded inside.
        *arguments: Of the function.
        first: Context of this call.
        again: Context of the calls in the backward pass, entered once for each.
    """
    if not torch.is_grad_enabled():
        with first:
            return function(*arguments)
    return checkpoint(
        function,
        *arguments,
        use_reentrant=False,
        preserve_rng_state=False,
        context_fn=lambda: (first, again),
    )


def seeds(network: nn.Module, count: int) -> Sequence[int | None]:
    """Seeds for so many runs of a network, drawn from torch's generator; None where none is needed.

    Args:
        network: In evaluation mode it draws nothing, and nothing is drawn here.
        count: How many.
    """
    if not any(module.training for module in network.modules()):
        return [None] * count
    drawn: list[int] = torch.randint(2**62, (count,)).tolist()
    return drawn


@contextmanager
def same_draws(seed: int | None, device: torch.device) -> Iterator[None]:
    """Random numbers that only depend on a seed, on the CPU and on a GPU; afterwards as before.

    Args:
        seed: None to change nothing.
        device: Of the tensors.
    """
    if seed is None:
        yield
        return
    on_gpu = device.type == "cuda"
    with torch.random.fork_rng([device] if on_gpu else [], device_type="cuda"):
        torch.default_generator.manual_seed(seed)
        with torch.cuda.device(device) if on_gpu else nullcontext():
            if on_gpu:
                torch.cuda.manual_seed(seed)
            yield


def joined(parts: Sequence[Any]) -> Any:
    """Results of a network for parts of a batch as those of the batch.

    Args:
        parts: Tensors, or mappings of tensors.
    """
    first = parts[0]
    if isinstance(first, Tensor):
        return torch.cat(list(parts))
    if isinstance(first, Mapping):
        return {name: joined([part[name] for part in parts]) for name in first}
    raise TypeError(type(first).__name__)
