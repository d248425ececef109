"""Tensors of trained networks: reading, fetching and strict loading."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from http.client import HTTPException
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models import WeightsEnum

from tangent_train.errors import DataError
from tangent_train.files import load_plain

_PREFIX = "network."
"""Begins the names of the network's tensors in a checkpoint of this package."""

_DEEPEST = 8
"""Mappings inside each other that are searched in a file."""

_COUNTER = "num_batches_tracked"
"""A buffer of batch normalization that older files lack and nothing here uses."""


def tensors_for(network: nn.Module, path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file by the names that a network has for them.

    They are the tensors of the mapping in the file (``state_dict``, ``model``, or all of it) and of
    the prefix in it (``module.``, ``_orig_mod.``, ``model.net.``, …) with the most fitting names;
    of several, those in ``state_dict``. Names are compared without ``network.``, and without the
    commonest prefix of the network's names.

    Args:
        network: The network.
        path: See `read_tensors`.

    Raises:
        DataError: The file cannot be read, or several mappings or prefixes (``student.``,
            ``teacher.``) with different tensors fit equally well.
    """
    names = {_inner(name): name for name in network.state_dict()}
    given = {
        place: {_inner(name): tensor for name, tensor in tensors.items()}
        for place, tensors in read_tensors(path).items()
    }
    fitting: dict[tuple[str, str, str], int] = {}
    for place, tensors in given.items():
        inside, count = _prefixes(names, tensors)[0]
        for outside, of_outside in _prefixes(tensors, names):
            fitting[place, outside, inside] = max(count, of_outside)
    best = [key for key, count in fitting.items() if count == max(fitting.values())]
    best = [key for key in best if key[0] == "state_dict"] or best

    def renamed(place: str, outside: str, inside: str) -> dict[str, Tensor]:
        new = {n: inside + n.removeprefix(outside) for n in given[place] if n.startswith(outside)}
        return {names.get(after, after): given[place][before] for before, after in new.items()}

    place, prefix, _ = best[0]
    first = renamed(*best[0])
    for other in best[1:]:
        second = renamed(*other)
        is_part = other[0] == place and other[1].startswith(prefix)
        if not is_part and not all(_equal(first.get(n), second.get(n)) for n in names.values()):
            shown = dict.fromkeys(f"{place}.{prefix}".strip(".") for place, prefix, _ in best)
            raise DataError(
                path,
                found=f"networks with different tensors: {', '.join(filter(None, shown))}",
                expected="the tensors of one network, or of several one called state_dict",
                remedy=f"Save one of them alone, for example {list(shown)[-1]}.",
            )
    return first


def _equal(one: Tensor | None, other: Tensor | None) -> bool:
    return one is other or (one is not None and other is not None and torch.equal(one, other))


def read_tensors(path: Path) -> dict[str, dict[str, Tensor]]:
    """Read the mappings with tensors in a file, by place, e.g. ``state_dict``; the whole is "".

    Names of tensors in mappings inside them are joined by dots. Those of ``state_dict`` are the
    ones under ``network.`` if there are any, as in checkpoints of this package.

    Args:
        path: A file of `torch.save`, of which only tensors and plain values are unpickled, or a
            ``.safetensors`` file.

    Raises:
        DataError: There is no such file, or it holds something else.
    """
    expected = "a state dict of tensors, or a checkpoint with one"
    if path.suffix == ".safetensors":
        try:
            content: Any = load_file(path)
        except (SafetensorError, OSError) as error:
            found = f"an unreadable file ({error})" if path.is_file() else "no such file"
            raise DataError(path, found=found, expected=expected) from error
    else:
        content = load_plain(path, expected)
    mappings = _mappings(content, set()) if isinstance(content, Mapping) else {}
    if not mappings:
        raise DataError(path, found="no named tensors", expected=expected)
    whole = mappings.get("state_dict", {})
    ours = {name: tensor for name, tensor in whole.items() if name.startswith(_PREFIX)}
    return mappings | ({"state_dict": ours} if ours else {})


def _mappings(
    content: Mapping[Any, Any], seen: set[int], depth: int = 0
) -> dict[str, dict[str, Tensor]]:
    """Return the mappings with tensors in a mapping, each once, itself as ""."""
    seen.add(id(content))
    tensors: dict[str, Tensor] = {}
    inside: dict[str, dict[str, Tensor]] = {}
    for name, value in content.items():
        if not isinstance(name, str):
            continue
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, Mapping) and id(value) not in seen and depth < _DEEPEST:
            found = _mappings(value, seen, depth + 1)
            inside |= {f"{name}.{place}".rstrip("."): within for place, within in found.items()}
            tensors |= {f"{name}.{inner}": tensor for inner, tensor in found.get("", {}).items()}
    return ({"": tensors} if tensors else {}) | inside


def _inner(name: str) -> str:
    """Return a name without the attributes by which modules of this package hold a network."""
    return ".".join(part for part in name.split(".") if part != "network")


def _prefixes(names: Iterable[str], ends: Mapping[str, object]) -> list[tuple[str, int]]:
    """Return prefixes before these ends with their numbers of names, the commonest first."""
    counts: Counter[str] = Counter()
    for name in names:
        parts = name.split(".")
        for k in range(len(parts)):
            if ".".join(parts[k:]) in ends:
                counts["".join(f"{part}." for part in parts[:k])] += 1
    return sorted(counts.items(), key=lambda item: (-item[1], len(item[0]))) or [("", 0)]


def fetch_tensors(weights: WeightsEnum) -> dict[str, Tensor]:
    """Return tensors that torchvision publishes, from the local cache or the internet.

    Raises:
        DataError: They are not in the cache and cannot be fetched.
    """
    try:
        tensors = weights.get_state_dict(
            progress=True, check_hash=True, map_location="cpu", weights_only=True
        )
    except (OSError, HTTPException, RuntimeError) as error:
        cached = Path(torch.hub.get_dir(), "checkpoints", weights.url.rpartition("/")[2])
        raise DataError(
            weights.url,
            found=f"no way to fetch it ({error})",
            expected="an internet connection the first time these weights are used",
            remedy=f"Fetch it on another machine and save it as {cached}.",
        ) from error
    return dict(tensors)


def load_tensors(
    network: nn.Module, tensors: Mapping[str, Tensor], source: object, fresh: str | None = None
) -> None:
    """Load a network's tensors; every one must be there and fit.

    Args:
        network: The network, changed in place.
        tensors: Names and values.
        source: Source of the tensors, for the message.
        fresh: Prefix of the names of tensors that are not loaded; None where all are.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape.
    """
    kept = {
        name: tensor
        for name, tensor in network.state_dict().items()
        if _COUNTER in name or (fresh is not None and name.startswith(fresh))
    }
    try:
        network.load_state_dict({**kept, **tensors})
    except RuntimeError as error:
        raise DataError(
            source,
            found=error,
            expected=f"the tensors of {type(network).__name__}",
            remedy="Are they of the same network with the same settings, its depth for example?",
        ) from error
