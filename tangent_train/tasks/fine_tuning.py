"""Training parts of a network: frozen ones, and others at a lower learning rate."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from tangent_train.errors import SettingError

__all__ = ["freeze", "groups_of", "rates_of"]

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
    frozen = []
    for name in names:
        if not name or (name not in modules and name not in parameters):
            raise SettingError(
                "task.frozen",
                found=name or "an empty name",
                expected=f"modules or parameters, such as {', '.join(_near(name, modules))}",
            )
        if name in modules:
            frozen.append(modules[name].requires_grad_(False).eval())
        else:
            parameters[name].requires_grad_(False)
    if parameters and not any(parameter.requires_grad for parameter in parameters.values()):
        raise SettingError("task.frozen", found="all of the network", expected="parts of it")
    return frozen


def _near(name: str, modules: Mapping[str, nn.Module]) -> list[str]:
    """Names to suggest for a wrong one: the parts of its last module that exists."""
    while name not in modules:
        name = name.rpartition(".")[0]
    return _parts(modules[name], f"{name}." if name else "") or [name]


def _parts(network: nn.Module, prefix: str = "") -> list[str]:
    """Names of the largest modules, within a module that holds all of them."""
    children = dict(network.named_children())
    if len(children) == 1:
        (name,) = children
        return _parts(children[name], f"{prefix}{name}.") or [f"{prefix}{name}"]
    return [prefix + name for name in children]


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
