"""Tensors of trained networks: reading and fetching them, and loading all of them or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models import WeightsEnum

from tangent_train.errors import DataError

__all__ = ["fetch_tensors", "load_tensors", "read_tensors"]

_PREFIX = "network."
"""Begins the names of the network's tensors in a checkpoint of this package."""

_COUNTER = "num_batches_tracked"
"""Of batch normalization. Files from before it was introduced lack it; nothing here uses it."""

_NAMED = 3


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a state dict, or those under ``network.`` of a checkpoint, by name.

    Args:
        path: A file that `torch.save` wrote, of which nothing but tensors and plain values is
            unpickled, or a ``.safetensors`` file.

    Raises:
        DataError: There is no such file, or it holds something else.
    """
    expected = "a state dict of tensors, or a checkpoint with one"
    if not path.is_file():
        raise DataError(path, found="no such file", expected=expected)
    try:
        content = _read(path)
    except Exception as error:
        first_line = str(error).partition("\n")[0]
        raise DataError(
            path, found=f"an unreadable file ({first_line})", expected=expected
        ) from error
    if isinstance(content, dict) and isinstance(content.get("state_dict"), dict):
        inside = content["state_dict"]
        ours = {n.removeprefix(_PREFIX): t for n, t in inside.items() if n.startswith(_PREFIX)}
        content = ours or inside
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(tensor, Tensor) for tensor in content.values())
    ):
        raise DataError(path, found="something else", expected=expected)
    return dict(content)


def _read(path: Path) -> Any:
    if path.suffix == ".safetensors":
        return load_file(path)
    return torch.load(path, map_location="cpu", weights_only=True)


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
            remedy="Fetch the file on another machine and set network.weights to its path.",
        ) from error
    return dict(tensors)


def load_tensors(
    network: nn.Module, tensors: Mapping[str, Tensor], source: object, fresh: str
) -> None:
    """Load a network's tensors: every one must be there and fit, or none is loaded.

    Args:
        network: Into which.
        tensors: Names and values.
        source: Where they come from, for the message.
        fresh: What the names of those tensors begin with that are not loaded.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape; they are named.
    """
    own = network.state_dict()
    wanted = {n: t for n, t in own.items() if not n.startswith(fresh)}
    problems = {
        "missing": [n for n in wanted if n not in tensors and not n.endswith(_COUNTER)],
        "unexpected": [n for n in tensors if n not in wanted],
        "of another shape": [
            f"{n} {tuple(tensors[n].shape)} instead of {tuple(t.shape)}"
            for n, t in wanted.items()
            if n in tensors and tensors[n].shape != t.shape
        ],
    }
    found = [f"{kind}: {_listed(names)}" for kind, names in problems.items() if names]
    if found:
        raise DataError(
            source,
            found="; ".join(found),
            expected=f"the tensors of {type(network).__name__}",
            remedy="Are they of the same network with the same settings, its depth for example?",
        )
    network.load_state_dict({**own, **tensors})


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
