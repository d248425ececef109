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
    """The tensors of a file by the names that a network has for them.

    They are those of the mapping in the file (``state_dict``, ``model``, or all of it) with the
    most fitting names. Names are compared without ``network.``, and without the commonest prefix of
    the file's names (``module.``, ``_orig_mod.``, ``model.net.``, …) and of the network's.

    Args:
        network: The network.
        path: See `read_tensors`.

    Raises:
        DataError: The file cannot be read, several mappings with different tensors fit equally
            well and none is called ``state_dict``, or a mapping has two networks with different
            tensors (``student.``, ``teacher.``).
    """
    own = network.state_dict()
    given = read_tensors(path)
    found = {place: _renamed(tensors, own) for place, tensors in given.items()}
    fitting = {place: len(own.keys() & tensors.keys()) for place, tensors in found.items()}
    best = [place for place, count in fitting.items() if count == max(fitting.values())]
    if "state_dict" in best:
        _check_alone(given["state_dict"], own, path)
        return found["state_dict"]
    first = found[best[0]]
    if any(found[place].get(name) is not first.get(name) for place in best for name in own):
        raise DataError(
            path,
            found=f"several state dicts: {', '.join(filter(None, best))}",
            expected="the tensors of one network, or of several one called state_dict",
            remedy=f"Save one of them alone: torch.save(torch.load(…)['{best[-1]}'], 'state.pt').",
        )
    _check_alone(given[best[0]], own, path)
    return first


def _check_alone(tensors: Mapping[str, Tensor], own: Iterable[str], path: Path) -> None:
    """Refuse a mapping with a second network of other tensors, under another prefix."""
    inner = {_inner(name): tensor for name, tensor in tensors.items()}
    counts = _prefixes(inner, {_inner(name): name for name in own})
    first, *others = sorted(counts, key=lambda prefix: (-counts[prefix], len(prefix))) or [""]
    for other in others:
        pairs = [
            (tensor, inner.get(other + name.removeprefix(first)))
            for name, tensor in inner.items()
            if name.startswith(first)
        ]
        is_second = counts[other] == counts[first] and not other.startswith(first)
        if is_second and not all(b is not None and torch.equal(a, b) for a, b in pairs):
            raise DataError(
                path,
                found=f"two networks with different tensors: {first}* and {other}*",
                expected="the tensors of one network",
                remedy=f"Save one of them alone: keep the names that begin with {first} or those "
                f"that begin with {other}.",
            )


def read_tensors(path: Path) -> dict[str, dict[str, Tensor]]:
    """The mappings with tensors in a file, by their place, such as ``state_dict``; the whole is "".

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
    """The mappings with tensors in one, each once, itself as ""; see `read_tensors`."""
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


def _renamed(tensors: Mapping[str, Tensor], own: Iterable[str]) -> dict[str, Tensor]:
    """Tensors by the names of a network, see `tensors_for`."""
    inner_own = {_inner(name): name for name in own}
    inner = {_inner(name): tensor for name, tensor in tensors.items()}
    outside, inside = _prefix(inner, inner_own), _prefix(inner_own, inner)
    renamed = {}
    for name, tensor in inner.items():
        if name.startswith(outside):
            place = inside + name.removeprefix(outside)
            renamed[inner_own.get(place, place)] = tensor
    return renamed


def _inner(name: str) -> str:
    """The name without the attributes by which modules of this package hold a network."""
    return ".".join(part for part in name.split(".") if part != "network")


def _prefix(names: Iterable[str], ends: Mapping[str, object]) -> str:
    """The commonest prefix, of equally common ones the shortest, before one of these ends."""
    counts = _prefixes(names, ends)
    return min(counts, key=lambda prefix: (-counts[prefix], len(prefix)), default="")


def _prefixes(names: Iterable[str], ends: Mapping[str, object]) -> Counter[str]:
    """Prefixes before one of these ends, with their numbers of names."""
    counts: Counter[str] = Counter()
    for name in names:
        parts = name.split(".")
        for k in range(len(parts)):
            if ".".join(parts[k:]) in ends:
                counts["".join(f"{part}." for part in parts[:k])] += 1
    return counts


def fetch_tensors(weights: WeightsEnum) -> dict[str, Tensor]:
    """Tensors that torchvision publishes, from the local cache or the internet.

    Raises:
        DataError: They are not in the cache and cannot be fetched.
    """
    try:
        tensors = weights.get_state_dict(
            progress=True, check_hash=True, map_location="cpu", weights_only=True
        )
    except (OSError, HTTPException, RuntimeError) as error:
        raise DataError(
            weights.url,
            found=f"no way to fetch it ({error})",
            expected="an internet connection the first time these weights are used",
            remedy=f"Fetch it on another machine and save it as {_cached(weights.url)}.",
        ) from error
    return dict(tensors)


def _cached(url: str) -> Path:
    """The file in which torch looks for what it has fetched."""
    return Path(torch.hub.get_dir(), "checkpoints", url.rpartition("/")[2])


def load_tensors(
    network: nn.Module, tensors: Mapping[str, Tensor], source: object, fresh: str | None = None
) -> None:
    """Load a network's tensors; every one must be there and fit.

    Args:
        network: The network, changed in place.
        tensors: Names and values.
        source: Their source, for the message.
        fresh: Prefix of the names of tensors that are not loaded; None where all are.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape.
    """
    own = {
        name: tensor
        for name, tensor in network.state_dict().items()
        if _COUNTER in name or (fresh is not None and name.startswith(fresh))
    }
    try:
        network.load_state_dict({**own, **tensors})
    except RuntimeError as error:
        raise DataError(
            source,
            found=error,
            expected=f"the tensors of {type(network).__name__}",
            remedy="Are they of the same network with the same settings, its depth for example?",
        ) from error
