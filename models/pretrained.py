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
"""Prefix of the network's tensors in checkpoints of this package."""

_COUNTER = "num_batches_tracked"
"""Buffer of batch normalization that older files lack and this package does not use."""


def tensors_for(network: nn.Module, path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file under the names that a network has for them.

    The mapping (``state_dict``, ``model``, or the whole file) and prefix (``module.``,
    ``_orig_mod.``, ``model.net.``, …) with the most fitting names are used; of several equally good
    ones, ``state_dict``. Names are compared without ``network.`` and without the most common prefix
    of the network's names.

    Args:
        network: Network that the tensors are for.
        path: File, see `read_tensors`.

    Raises:
        DataError: The file cannot be read.
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
    place, outside, inside = next((key for key in best if key[0] == "state_dict"), best[0])
    new = {n: inside + n.removeprefix(outside) for n in given[place] if n.startswith(outside)}
    return {names.get(after, after): given[place][before] for before, after in new.items()}


def read_tensors(path: Path) -> dict[str, dict[str, Tensor]]:
    """Read the mappings with tensors in a file, by key, e.g. ``state_dict``; "" is the file.

    Names in nested mappings are joined by dots. If ``state_dict`` has tensors under ``network.``,
    as in checkpoints of this package, only these are returned.

    Args:
        path: File from `torch.save`, from which only tensors and plain values are unpickled, or a
            ``.safetensors`` file.

    Raises:
        DataError: The file is missing, or has another content.
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
    mappings = _mappings(content) if isinstance(content, Mapping) else {}
    if not mappings:
        raise DataError(path, found="no named tensors", expected=expected)
    whole = mappings.get("state_dict", {})
    prefixed = {name: tensor for name, tensor in whole.items() if name.startswith(_PREFIX)}
    return mappings | ({"state_dict": prefixed} if prefixed else {})


def _mappings(content: Mapping[Any, Any]) -> dict[str, dict[str, Tensor]]:
    """Return the mappings with tensors in a mapping; "" is itself."""
    tensors: dict[str, Tensor] = {}
    inside: dict[str, dict[str, Tensor]] = {}
    for name, value in content.items():
        if not isinstance(name, str):
            continue
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, Mapping):
            found = _mappings(value)
            inside |= {f"{name}.{place}".rstrip("."): within for place, within in found.items()}
            tensors |= {f"{name}.{inner}": tensor for inner, tensor in found.get("", {}).items()}
    return ({"": tensors} if tensors else {}) | inside


def _inner(name: str) -> str:
    """Return a name without the attributes of this package's wrapper modules."""
    return ".".join(part for part in name.split(".") if part != "network")


def _prefixes(names: Iterable[str], ends: Mapping[str, object]) -> list[tuple[str, int]]:
    """Return the prefixes of names with these ends and their counts, most common first."""
    counts: Counter[str] = Counter()
    for name in names:
        parts = name.split(".")
        for k in range(len(parts)):
            if ".".join(parts[k:]) in ends:
                counts["".join(f"{part}." for part in parts[:k])] += 1
    return sorted(counts.items(), key=lambda item: (-item[1], len(item[0]))) or [("", 0)]


def fetch_tensors(weights: WeightsEnum) -> dict[str, Tensor]:
    """Return tensors published by torchvision, from the local cache or the internet.

    Raises:
        DataError: The tensors are not in the cache and cannot be fetched.
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
    """Load all tensors of a network; a missing or unfitting tensor is an error.

    Args:
        network: Network, changed in place.
        tensors: Tensors by name.
        source: Source of the tensors, for error messages.
        fresh: Prefix of the names of tensors that are not loaded; None to load all.

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
