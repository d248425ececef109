"""Tensors of trained networks: reading, fetching and strict loading."""

from __future__ import annotations

from collections.abc import Mapping
from http.client import HTTPException
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models import WeightsEnum

from tangent_train.errors import DataError
from tangent_train.files import load_plain

_PREFIX = "network."
"""Begins the names of the network's tensors in a checkpoint of this package."""

_COUNTER = "num_batches_tracked"
"""A buffer of batch normalization that older files lack and nothing here uses."""


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a state dict, or those under ``network.`` of a checkpoint, by name.

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
