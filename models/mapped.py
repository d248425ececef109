"""Convolutions on irregular grids: a sparse table collects values, weights combine them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn
from torch.nn import functional

from models.unet import check_size


class _Bags(NamedTuple):
    """A sparse matrix by rows, in the form that `embedding_bag` takes.

    Attributes:
        columns: Column of each entry, row after row.
        starts: Number of the first entry of each row.
        values: Value of each entry.
    """

    columns: Tensor
    starts: Tensor
    values: Tensor


def _bags(matrix: Any, device: torch.device, dtype: torch.dtype) -> _Bags:
    """Copy a sparse matrix of SciPy to a device."""
    rows = matrix.tocsr()
    columns, starts = (torch.from_numpy(a).int() for a in (rows.indices, rows.indptr[:-1]))
    values = torch.from_numpy(rows.data).to(device, dtype)
    return _Bags(columns.to(device), starts.to(device), values)


@dataclass(frozen=True, eq=False)
class Table:
    """A sparse matrix T that collects K values for each of V_out positions from V_in positions.

    It follows from geometry alone, so that no checkpoint contains it. Layers share one table, and
    its copies for a device and a precision, which are made when they are first used.

    Attributes:
        matrix: ``(V_out · K, V_in)`` float64 matrix in SciPy's CSR format; row v·K + k is value k
            of position v.
        taps: Number K of values per position.
    """

    matrix: Any
    taps: int
    _copies: dict[tuple[torch.device, torch.dtype], tuple[_Bags, _Bags]] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def of_entries(
        cls, indices: NDArray[np.integer], weights: NDArray[np.float64], inputs: int
    ) -> Table:
        """Build a table from the same number m of input positions for each value.

        Args:
            indices: ``(V_out, K, m)`` input positions.
            weights: Weights of these positions; the shape broadcasts to that of the indices.
            inputs: Number V_in of input positions.
        """
        outputs, taps, entries = indices.shape
        values = np.broadcast_to(weights, indices.shape).astype(np.float64).ravel()
        starts = np.arange(outputs * taps + 1, dtype=np.int32) * entries
        shape = outputs * taps, inputs
        matrix = sparse.csr_array((values, indices.ravel().astype(np.int32), starts), shape)
        matrix.sum_duplicates()
        matrix.eliminate_zeros()
        return cls(matrix, taps)

    @classmethod
    def of_operators(cls, operators: Sequence[Any]) -> Table:
        """Build a table from K sparse matrices ``(V_out, V_in)`` of SciPy."""
        taps, outputs = len(operators), operators[0].shape[0]
        order = np.arange(taps * outputs).reshape(taps, outputs).T.ravel()
        return cls(sparse.vstack(operators, "csr")[order], taps)

    @property
    def inputs(self) -> int:
        """Number V_in of input positions."""
        return int(self.matrix.shape[1])

    @property
    def outputs(self) -> int:
        """Number V_out of output positions."""
        return int(self.matrix.shape[0]) // self.taps

    def __deepcopy__(self, memo: dict[int, Any]) -> Table:
        """Return the table itself: copies of a network share it."""
        return self

    def bags(self, device: torch.device, dtype: torch.dtype) -> tuple[_Bags, _Bags]:
        """Return T and its transpose on a device."""
        key = device, dtype
        if key not in self._copies:
            self._copies[key] = _bags(self.matrix, *key), _bags(self.matrix.T, *key)
        return self._copies[key]

    def padded(self) -> tuple[Tensor, Tensor]:
        """Return columns and values ``(V_out · K, m)``, filled up with zeros."""
        counts = np.diff(self.matrix.indptr)
        is_entry = np.arange(counts.max()) < counts[:, None]
        columns, values = np.zeros(is_entry.shape, np.int64), np.zeros(is_entry.shape, np.float32)
        columns[is_entry], values[is_entry] = self.matrix.indices, self.matrix.data
        return torch.from_numpy(columns), torch.from_numpy(values)


class _Product(torch.autograd.Function):
    """The product of a sparse matrix and each of several dense ones."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, matrix: _Bags, transposed: _Bags) -> Tensor:
        ctx.matrices = transposed, matrix
        columns, starts, values = matrix
        # On a CPU, this is twice as fast as the product of torch.sparse.
        return torch.stack(
            [
                functional.embedding_bag(
                    columns, one, starts, mode="sum", per_sample_weights=values
                )
                for one in x
            ]
        )

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        product: Tensor = _Product.apply(gradients[0].contiguous(), *ctx.matrices)
        return product, None, None


def collect(
    signals: Float[Tensor, "batch channels height width"], table: Table
) -> Float[Tensor, "batch outputs values"]:
    """Return T x, computed with at least the precision of float32.

    Args:
        signals: ``(batch, channels, 1, V_in)``, fastest as ``channels_last``.
        table: The table.

    Returns:
        ``(batch, V_out, K · channels)``; value k of channel c is number k · channels + c.
    """
    rows = signals[:, :, 0].transpose(1, 2)
    rows = rows.to(torch.promote_types(rows.dtype, torch.float32))
    if torch.compiler.is_exporting():  # no format of networks has a sparse product
        columns, values = table.padded()
        product = (rows[:, columns] * values[:, :, None]).sum(2)
    else:
        product = _Product.apply(rows.contiguous(), *table.bags(rows.device, rows.dtype))
    shape = -1, table.outputs, table.taps * rows.shape[2]
    return product.reshape(shape).to(signals.dtype)


class MappedConv(nn.Module):
    """Convolution whose taps a table collects (Eder et al. 2019): y = W · reshape(T x) + b.

    Args:
        in_channels: Input channels C.
        out_channels: Output channels C'.
        table: Table with K values per position.
        bias: True to add a bias.
    """

    def __init__(
        self, in_channels: int, out_channels: int, table: Table, bias: bool = True
    ) -> None:
        super().__init__()
        self.table = table
        self.fixed_size = (1, table.inputs)
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, table.taps))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        bound = (in_channels * table.taps) ** -0.5
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound)

    def forward(
        self, signals: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch outchannels 1 outputs"]:
        """Return signals on the output positions, in memory as ``channels_last``.

        Raises:
            SettingError: The signals are images, or have another number of positions.
        """
        check_size(signals, self, size=self.fixed_size)
        weight = self.weight.transpose(1, 2).flatten(1)
        values = functional.linear(collect(signals, self.table), weight, self.bias)
        return values.transpose(1, 2).unsqueeze(2)
