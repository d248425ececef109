"""Training parts of a network: frozen ones, and others at a lower learning rate."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from tangent_train.errors import SettingError

_RATES = ("max_lr", "base_lr")
"""Arguments of schedulers that replace the learning rate of the optimizer."""


def freeze(network: nn.Module, names: Iterable[str]) -> list[nn.Module]:
    """Exclude parts of a network from training.

    Args:
        network: Changed in place: parameters of these parts need no gradient.
        names: Full names of modules or parameters in it.

    Returns:
        The modules among them. In evaluation mode, their batch statistics stay as they are.

    Raises:
        SettingError: There is no such part, or nothing is left to train.
    """
    modules, parameters = dict(network.named_modules()), dict(network.named_parameters())
    del modules[""]
    frozen = []
    for name in names:
        if name not in modules and name not in parameters:
            beside = [n for n in (*modules, *parameters) if _parent(n) == _parent(name)]
            near = ", ".join(beside or dict(network.named_children()))
            raise SettingError(
                "task.frozen",
                found=name or "an empty name",
                expected=f"modules or parameters, such as {near}",
            )
        if name in modules:
            frozen.append(modules[name].requires_grad_(False).eval())
        else:
            parameters[name].requires_grad_(False)
    if parameters and not any(parameter.requires_grad for parameter in parameters.values()):
        raise SettingError("task.frozen", found="all of the network", expected="parts of it")
    return frozen


def _parent(name: str) -> str:
    return name.rpartition(".")[0]


def groups_of(parameters: Mapping[str, Tensor], fresh: Collection[str]) -> list[dict[str, Any]]:
    """Groups for an optimizer: the parameters that were loaded, as ``backbone``, and ``new`` ones.

    Args:
        parameters: By name.
        fresh: Names of tensors that were not loaded.
    """
    new = [parameter for name, parameter in parameters.items() if name in fresh]
    loaded = [parameter for name, parameter in parameters.items() if name not in fresh]
    groups = [{"params": loaded, "name": "backbone"}, {"params": new, "name": "new"}]
    return [group for group in groups if group["params"]]


def rates_of(scheduler: Any, factors: Sequence[float]) -> dict[str, list[float]]:
    """Learning rates that a scheduler's settings give, for every group of the optimizer.

    Args:
        scheduler: A `functools.partial`.
        factors: Of every group.
    """
    given = getattr(scheduler, "keywords", {})
    return {
        name: [given[name] * factor for factor in factors]
        for name in _RATES
        if isinstance(given.get(name), int | float)
    }
