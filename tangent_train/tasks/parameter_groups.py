"""Train parts of a network: freeze some, and train others at a lower learning rate."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from tangent_train.errors import SettingError

_RATES = ("max_lr", "base_lr")
"""Arguments with which schedulers replace the learning rate of the optimizer."""


def freeze(network: nn.Module, names: Iterable[str]) -> list[nn.Module]:
    """Exclude parts of a network from training.

    Args:
        network: Network, changed in place: parameters of these parts need no gradient.
        names: Full names of modules or parameters in the network.

    Returns:
        Frozen modules, in evaluation mode, which keeps their batch statistics unchanged.

    Raises:
        SettingError: A part does not exist.
    """
    modules, parameters = dict(network.named_modules()), dict(network.named_parameters())
    frozen = []
    for name in names:
        if name in parameters:
            parameters[name].requires_grad_(False)
        elif name and name in modules:
            frozen.append(modules[name].requires_grad_(False).eval())
        else:
            examples = ", ".join(child for child, _ in network.named_children())
            raise SettingError(
                "task.frozen",
                found=name or "an empty name",
                expected=f"modules or parameters, such as {examples}",
            )
    return frozen


def groups_of(parameters: Mapping[str, Tensor], fresh: Collection[str]) -> list[dict[str, Any]]:
    """Return groups for an optimizer: ``backbone``, the loaded parameters, and ``new``, the others.

    Args:
        parameters: Parameters by name.
        fresh: Names of tensors that were not loaded.
    """
    new = [parameter for name, parameter in parameters.items() if name in fresh]
    loaded = [parameter for name, parameter in parameters.items() if name not in fresh]
    groups = [{"params": loaded, "name": "backbone"}, {"params": new, "name": "new"}]
    return [group for group in groups if group["params"]]


def rates_of(scheduler: Any, factors: Sequence[float]) -> dict[str, list[float]]:
    """Return the learning rates in a scheduler's settings for each group of the optimizer.

    Args:
        scheduler: `functools.partial` that builds the scheduler.
        factors: Factor of the learning rate of each group.
    """
    settings = getattr(scheduler, "keywords", {})
    return {
        name: [settings[name] * factor for factor in factors]
        for name in _RATES
        if isinstance(settings.get(name), int | float)
    }
