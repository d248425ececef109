"""Convolutions on irregular grids: a sparse table collects values, weights combine them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn
from torch.nn import functional

from models.unet import check_size
from tangent_train.geometry import icosphere, vertex_resolution
from tangent_train.geometry.icosphere import icosphere_directions, locate
from tangent_train.geometry.sphere import gnomonic_points_xyz, tangent_axes


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
        check_size(signals.shape[-2:], self, 1, self.fixed_size)
        weight = self.weight.transpose(1, 2).flatten(1)
        values = functional.linear(collect(signals, self.table), weight, self.bias)
        return values.transpose(1, 2).unsqueeze(2)


@cache
def mesh_operators(level: int) -> Table:
    """Return the four rows of MeshConv (Jiang et al. 2019, equation 3): x, L x, ∂EW x, ∂NS x.

    L is the cotangent Laplacian without division by the area of a vertex. The derivatives towards
    east and north are those of the linear function on each face, along EW = NS × n and the gradient
    NS of the latitude, averaged over the faces of a vertex by area.

    The article has derivatives per radian on a sphere of radius 1. Here, they are per vertex
    spacing `vertex_resolution(level)`, and L is divided by 2√3, so that it is the mean of the ring
    minus the value where triangles are equilateral. Weights absorb these constants of a level, but
    training is faster when no row outweighs the others. A pole has neither east nor north: its
    rows average the derivatives along NS and EW of its five faces, which tend to 0 for smooth
    functions.

    Args:
        level: Level s of the icosphere.
    """
    faces, points = icosphere(level).faces, icosphere_directions(level)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    double_normals = np.cross(b - a, c - a)
    double_areas = np.linalg.norm(double_normals, axis=1, keepdims=True)
    normals, areas = double_normals / double_areas, double_areas[:, 0] / 2
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    gradients = np.cross(normals[:, None], opposite) / double_areas[:, None]  # (F, 3, 3)

    latitudes = np.arcsin(np.clip(points[:, 2], -1, 1))
    north = np.einsum("fi,fix->fx", latitudes[faces], gradients)
    outward = normals * np.sign((normals * a).sum(axis=1, keepdims=True))
    east = np.cross(north, outward)
    shares = areas[:, None] / np.bincount(faces.ravel(), np.repeat(areas, 3))[faces]

    at, of = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()

    def assembled(entries: NDArray[np.float64]) -> sparse.csr_array:
        shape = len(points), len(points)
        return sparse.coo_array((entries.ravel(), (at, of)), shape).tocsr()

    laplacian = -areas[:, None, None] * np.einsum("fix,fjx->fij", gradients, gradients)
    shares = shares * vertex_resolution(level)
    derivatives = [
        shares[:, :, None] * np.einsum("fx,fjx->fj", along, gradients)[:, None]
        for along in (east, north)
    ]
    identity = sparse.eye_array(len(points), format="csr")
    return Table.of_operators([identity, *map(assembled, (laplacian / 12**0.5, *derivatives))])


@cache
def hexagonal_rings(level: int) -> Table:
    """Return the seven rows of HexConv (Zhang et al. 2019, section 3.2): a vertex and its ring.

    The ring starts in the north and continues counterclockwise, as seen from outside. Its row k is
    α x[n_k] + (1 − α) x[n_(k+1)] for the neighbors n of the vertex, of which n_0 and n_1 enclose
    the north; α is the share of their angle between n_1 and the north. The convolution is the
    paper's α (W¹ * x) + (1 − α) (W² * x), where W² has the ring of W¹ shifted by one.

    The paper leaves out the poles, and pads the ten other vertices with five neighbors. Here, six
    rows divide the ring of five evenly. A pole has no north: its six rows are the mean of the ring.

    Args:
        level: Level s of the icosphere.
    """
    vertices, faces = icosphere(level)
    origin, neighbor = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).T
    axes = tangent_axes(vertices)[origin, :2]
    bearing = np.arctan2(*np.einsum("nij,nj->in", axes, vertices[neighbor])) % (2 * np.pi)
    order = np.lexsort((bearing, origin))
    origin, neighbor, bearing = origin[order], neighbor[order], bearing[order]

    valence = np.bincount(origin)
    end = valence.cumsum()
    start = end - valence
    before = 2 * np.pi - bearing[end - 1]  # from the last neighbor to the north
    north = valence - 1 + before / (before + bearing[start])
    is_pole = np.hypot(*vertices[:, :2].T) < 1e-9
    at_pole, of_pole = origin[is_pole[origin]], neighbor[is_pole[origin]]
    inside = np.flatnonzero(~is_pole)
    start, valence = start[inside], valence[inside]
    operators = [sparse.eye_array(len(vertices), format="csr")]
    for k in range(6):
        share, first = np.modf(north[inside] + k * valence / 6)
        ends = [neighbor[start + (first.astype(np.int64) + i) % valence] for i in (0, 1)]
        values = np.concatenate([1 - share, share, np.full(len(of_pole), 1 / 5)])
        entries = np.concatenate([inside, inside, at_pole]), np.concatenate([*ends, of_pole])
        operators.append(sparse.coo_array((values, entries), operators[0].shape).tocsr())
    return Table.of_operators(operators)


@cache
def face_neighbors(level: int) -> Table:
    """Return the ten rows of SpherePHD (Lee et al. 2019, figure 5), for signals on faces.

    They are a face, the three faces across its edges, and the six next to these, in the order of
    the corners. Corner 0 points to the north in the upward faces of the unfolded icosahedron, to
    the south in the downward ones: their order is that of the upward ones turned by 180°. Around a
    vertex with five faces, the ten faces are different too.

    Args:
        level: Level s of the icosphere.
    """
    faces = icosphere(level).faces
    count = len(faces)
    edges = faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)  # opposite to corners 0, 1, 2
    code, reverse = edges @ [count, 1], edges @ [1, count]
    order = code.argsort()
    across = order[np.searchsorted(code, reverse, sorter=order)]
    # Corner 0 of the icosahedron's faces 5 to 9 lies on their upper edge.
    top = np.repeat([0, 1, 0], [count // 4, count // 4, count // 2])
    start = across[3 * np.arange(count)[:, None] + (top[:, None] + np.arange(3)) % 3]
    sides = start[:, :, None] // 3 * 3 + (start[:, :, None] + [1, 2]) % 3
    rows = np.arange(count)[:, None], start // 3, across[sides].reshape(count, 6) // 3
    return Table.of_entries(np.concatenate(rows, axis=1)[..., None], np.ones(1), count)


@cache
def vertex_parents(level: int) -> Table:
    """Return the table that doubles the resolution of signals on vertices, with one value each.

    A vertex of the coarser level keeps its value; a new vertex, on an edge, takes the mean of the
    edge's two ends.

    Args:
        level: Level of the result, at least 1.
    """
    coarse = icosphere(level - 1)
    parents = np.tile(np.arange(len(icosphere(level).vertices))[:, None], 2)
    parents[icosphere(level).faces[3::4]] = coarse.faces[:, [[1, 2], [2, 0], [0, 1]]]
    return Table.of_entries(parents[:, None], np.array(0.5), len(coarse.vertices))


@cache
def gnomonic_points(level: int) -> Table:
    """Return nine taps: a 3 × 3 grid on the tangent plane of each vertex, aligned to the north.

    Their distance on the plane is the tangent of the mean angle between neighboring vertices (Coors
    et al. 2018 and Tateno et al. 2018 use that of neighboring pixels). Rows are from north to
    south, columns from west to east, as in a convolution of images.

    Args:
        level: Level s of the icosphere.
    """
    pitch = float(np.tan(vertex_resolution(level)))
    return mapped_samples(level, gnomonic_points_xyz(icosphere_directions(level), 3, pitch))


def mapped_samples(level: int, directions_xyz: NDArray[np.float64]) -> Table:
    """Return a mapped convolution of signals on vertices (Eder et al. 2019): any taps.

    Args:
        level: Level s of the icosphere.
        directions_xyz: ``(V_out, K, 3)`` unit vectors. Values there are interpolated between the
            three vertices of a face, with barycentric weights.
    """
    found, weights = locate(level, directions_xyz.reshape(-1, 3))
    vertices, faces = icosphere(level)
    shape = (*directions_xyz.shape[:2], 3)
    return Table.of_entries(faces[found].reshape(shape), weights.reshape(shape), len(vertices))


@cache
def vertex_means(level: int) -> Table:
    """Return the table that halves the resolution of signals on vertices, with one value each.

    It is the mean of the seven rows of `hexagonal_rings`: a vertex and the neighbors around it.

    Args:
        level: Level of the signals, at least 1.
    """
    rings = hexagonal_rings(level)
    count = len(icosphere(level - 1).vertices)
    means = sparse.kron(sparse.eye_array(count), np.full((1, rings.taps), 1 / rings.taps), "csr")
    return Table.of_operators([means @ rings.matrix[: count * rings.taps]])
