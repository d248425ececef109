"""Counts operations of torch, and the bytes that they read and write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

_ONLY_SHAPE = ("empty", "new_full", "scalar_tensor")
"""Operations that do not read the tensors given to them."""


def _nbytes(*given: Any) -> int:
    tensors = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor)]
    # An expanded tensor is not larger than its memory.
    return sum(min(t.numel() * t.itemsize, t.untyped_storage().nbytes()) for t in tensors)


class Operations(TorchDispatchMode):
    """Counts operations outside of a network.

    Attributes:
        counts: Number of calls by operation. Views of other tensors do not count.
        nbytes: Bytes of the tensors that they read and write.
        images: Bytes of the images that the network takes.
        outputs: Bytes of what it returns.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.counts: Counter[str] = Counter()
        self.nbytes = self.images = self.outputs = 0
        self._is_outside = True

    def __torch_dispatch__(self, operation: Any, _: Any, given: Any = (), named: Any = None) -> Any:
        result = operation(*given, **(named or {}))
        returned = operation._schema.returns
        is_view = any(of.alias_info is not None and not of.alias_info.is_write for of in returned)
        if self._is_outside and not is_view:
            self.counts[str(operation)] += 1
            inputs = [value for name, value in (named or {}).items() if name != "out"]
            if not any(part in str(operation) for part in _ONLY_SHAPE):
                self.nbytes += _nbytes(given, inputs) + _nbytes(result)
        return result

    @contextmanager
    def outside(self, network: nn.Module) -> Iterator[None]:
        """Count what happens outside of calls of a network."""

        def enter(_: Any, images: Any) -> None:
            self.images += _nbytes(images)
            self._is_outside = False

        def leave(_: Any, __: Any, outputs: Any) -> None:
            self.outputs += _nbytes(outputs)
            self._is_outside = True

        hooks = network.register_forward_pre_hook(enter), network.register_forward_hook(leave)
        with self:
            yield
        for hook in hooks:
            hook.remove()
