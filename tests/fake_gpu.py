"""A GPU without a GPU: tensors of `FakeTensorMode` have a device and a shape and no numbers.

An operation on tensors of two devices is an error, and so is one that has to read a number (`item`,
`nonzero`, `bincount`), which would wait for a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class _Transfers(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Lists operations whose result is on another device than their arguments."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.found: list[str] = []

    def __torch_dispatch__(self, operation: Any, _: Any, given: Any = (), named: Any = None) -> Any:
        result = operation(*given, **(named or {}))
        before, after = (
            {leaf.device.type for leaf in tree_leaves(part) if isinstance(leaf, Tensor)}
            for part in ((given, named), result)
        )
        if before and after and before != after:
            self.found.append(f"from {before} to {after}")
        return result


@contextmanager
def fake_gpu(module: nn.Module | None = None) -> Iterator[list[str]]:
    """A module and new tensors are on a GPU; gives the transfers between devices.

    Args:
        module: It is moved to the GPU.
    """
    fake = FakeTensorMode(allow_non_fake_inputs=True)
    unpinned = patch.object(Tensor, "pin_memory", lambda tensor: tensor)  # not implemented by torch
    with fake, unpinned, torch.device("cuda"), _Transfers() as transfers:
        for part in () if module is None else module.modules():
            for held in (part._parameters, part._buffers):
                found: Any = {name: t for name, t in held.items() if t is not None}
                held.update({name: torch.empty_like(t, device="cuda") for name, t in found.items()})
        transfers.found.clear()
        yield transfers.found
