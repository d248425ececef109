"""The icosahedral CNN: convolutions that are equivariant under rotations of the icosahedron."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear

from models.icosphere_unet import levels_of
from models.unet import Convolution, ResidualUNet, check_size
from tangent_train.geometry.icosphere import icosphere, icosphere_count

_CORNERS = 12
"""The vertices with five neighbors: those of the icosahedron, the first ones at every level."""

_STEPS = ((0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1), (1, 0))
"""Rows and columns from a pixel of a chart to its neighbors 0 … 5, in the order of the faces."""

_Indices = NDArray[np.int64]


def _by_edge(faces: _Indices, values: _Indices) -> Callable[[_Indices, _Indices], _Indices]:
    """Return a function of directed edges (a, b): the value of the face (a, b, ·) opposite to a.

    Args:
        faces: ``(F, 3)`` vertices.
        values: ``(F, 3)`` values of the edges opposite to the vertices.
    """
    count = faces.max() + 1
    keys = (faces * count + faces[:, [1, 2, 0]]).ravel()
    order = np.argsort(keys)
    keys, of_keys = keys[order], values[:, [2, 0, 1]].ravel()[order]
    return lambda a, b: of_keys[np.searchsorted(keys, a * count + b)]


@cache
def _charts(level: int) -> _Indices:
    """Return ``(5, 2^r + 1, 2^(r+1) + 1)`` vertices of the charts with all their edges."""
    if level == 0:
        k, other = np.arange(5), (np.arange(5) + 1) % 5
        north, south = np.zeros(5, np.int64), np.full(5, _CORNERS - 1)
        corners = [[north, 1 + other, 6 + other], [1 + k, 6 + k, south]]
        return np.moveaxis(np.array(corners), -1, 0)
    coarse = _charts(level - 1)
    middle = _by_edge(icosphere(level - 1).faces, icosphere(level).faces[3::4])
    charts = np.empty((5, 2**level + 1, 2 ** (level + 1) + 1), np.int64)
    charts[:, ::2, ::2] = coarse
    charts[:, 1::2, ::2] = middle(coarse[:, 1:], coarse[:, :-1])
    charts[:, ::2, 1::2] = middle(coarse[:, :, 1:], coarse[:, :, :-1])
    charts[:, 1::2, 1::2] = middle(coarse[:, 1:, :-1], coarse[:, :-1, 1:])
    return charts


def _neighbors(level: int) -> tuple[_Indices, _Indices]:
    """Return ``(V, 6)`` neighbors of vertices, and the shifts of their frames.

    Orientation k at a vertex is orientation k + shift at its neighbor, transported along the edge.
    The sixth neighbor of a corner repeats the first. Values at corners do not depend on the
    orientation.
    """
    vertices, faces = icosphere(level)
    charts, following = _charts(level), _by_edge(faces, faces)
    neighbors = np.empty((len(vertices), 6), np.int64)
    neighbors[charts[:, 1:, :-1], 0] = charts[:, 1:, 1:]
    neighbors[[0, _CORNERS - 1], 0] = charts[0, 0, 1], charts[0, -1, -2]
    here = np.arange(len(vertices))
    for k in range(5):
        neighbors[:, k + 1] = following(here, neighbors[:, k])
    back = (neighbors[neighbors] == here[:, None, None]).argmax(axis=-1)
    return neighbors, (back + 3 - np.arange(6)) % 6


@cache
def atlas(level: int) -> dict[str, Tensor]:
    """Return indices of the icosphere of one level (Cohen et al. 2019, section 5).

    Five charts of 2^r × 2^(r+1) pixels contain every vertex but the poles. The frame of a vertex
    is aligned with its chart: orientation k points to neighbor k. The indices follow from the faces
    of `icosphere` alone; those with six rows refer to values ``(…, 6, V)``, flattened.
    They take 2 MiB at level 5 and 133 MiB at level 8, where they are made in 1.4 s.

    Returns:
        ``padded``: ``(6, 5, 2^r + 2, 2^(r+1) + 2)`` charts with a border of one pixel, whose
        orientations are those of the chart. ``pixels``: ``(V − 12,)`` places of the other vertices
        than the corners in the convolved charts. ``ring``: ``(12, 5)`` neighbors of the corners.
        ``pooled``: ``(6, 7, V′)`` vertices of the next coarser level and their neighbors.
        ``parents``: ``(6, 2, V″)`` vertices of the next coarser level beside each new vertex.
    """
    neighbors, shifts = _neighbors(level)
    count, fewer = len(neighbors), (len(neighbors) + 6) // 4 if level else 0
    pixels = _charts(level)[:, 1:, :-1]
    _, height, width = pixels.shape

    def indices(vertices: _Indices, shift: _Indices, total: int = count) -> Tensor:
        orientations = np.arange(6).reshape(6, *[1] * vertices.ndim)
        return torch.from_numpy((orientations + shift) % 6 * total + vertices)

    padded = np.zeros((2, 5, height + 2, width + 2), np.int64)
    padded[0, :, 1:-1, 1:-1] = pixels
    inside = pixels >= _CORNERS
    for k, (down, across) in enumerate(_STEPS):
        part = padded[:, :, 1 + down :, 1 + across :][:, :, :height, :width]
        part[:, inside] = neighbors[pixels[inside], k], shifts[pixels[inside], k]
    places = np.arange(5 * (height + 2) * width).reshape(5, height + 2, width)[:, :height]
    kept, new = np.arange(fewer), np.arange(fewer, count if level else 0)
    first = (neighbors[new, :3] < fewer).argmax(axis=-1)
    ends = new, np.stack([first, first + 3])
    return {
        "padded": indices(*padded),
        "pixels": torch.from_numpy(places.ravel()[np.argsort(pixels.ravel())][_CORNERS - 2 :]),
        "ring": torch.from_numpy(neighbors[:_CORNERS, :5]),
        "pooled": indices(
            np.vstack([kept, neighbors[kept].T]), np.vstack([0 * kept, shifts[kept].T])
        ),
        "parents": indices(neighbors[ends], shifts[ends], fewer),
    }


def _take(x: Tensor, indices: Tensor) -> Tensor:
    """Return the values of ``(n, C, …)`` at indices of any shape, ``(n, C, *indices.shape)``."""
    spread = indices.flatten().expand(*x.shape[:2], -1)
    return x.flatten(2).gather(-1, spread).reshape(*x.shape[:2], *indices.shape)


class _OnAtlas(nn.Module):
    """A layer with indices of a level, which are not part of checkpoints."""

    padded: Tensor
    pixels: Tensor
    ring: Tensor
    pooled: Tensor
    parents: Tensor

    def __init__(self, level: int, *names: str) -> None:
        super().__init__()
        for name in names:
            self.register_buffer(name, atlas(level)[name], persistent=False)


def _rotated_filters(orientations: int) -> Tensor:
    """Return ``(orientations, 7, 6, orientations, 3, 3)`` of zeros and ones.

    They map a filter (orientation of the input relative to the output, tap; the center is tap 0) to
    the 3×3 filters of each orientation of the output and of the input.
    """
    rotated = torch.zeros(orientations, 7, 6, orientations, 3, 3)
    for out, given in product(range(6), range(orientations)):
        filters = rotated[(given - out) % orientations, :, out, given]
        filters[0, 1, 1] = 1
        for k, (down, across) in enumerate(_STEPS):
            filters[1 + (k - out) % 6, 1 + down, 1 + across] = 1
    return rotated


class GaugeConv(_OnAtlas):
    """Gauge equivariant convolution of a vertex and its six neighbors (Cohen et al. 2019).

    Features are scalar, ``(n, C, 1, V)``, or regular, ``(n, C, 6, V)``: one value per orientation.
    The filters of all orientations are rotated copies of one, and charts are convolved by `conv2d`.
    At a corner, where no six directions exist, features are the same in all orientations: the
    filter is averaged over its rotations and applied to the mean of the five neighbors.

    Args:
        in_channels: Input channels C.
        out_channels: Output channels.
        level: Level r of the icosphere.
        given: Orientations of the input: 1 (scalar) or 6 (regular).
        returned: Orientations of the output; 1 is the mean of the six.
    """

    rotated: Tensor

    def __init__(
        self, in_channels: int, out_channels: int, level: int, given: int = 6, returned: int = 6
    ) -> None:
        super().__init__(level, "padded", "pixels", "ring")
        if given == 1:
            self.padded = self.padded[:1] % icosphere_count(level)
        self.returned, bound = returned, (in_channels * given * 7) ** -0.5
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, given, 7))
        self.bias = nn.Parameter(torch.empty(out_channels))
        for parameter in (self.weight, self.bias):
            nn.init.uniform_(parameter, -bound, bound)
        rotated = _rotated_filters(given).reshape(given, 7, returned, -1, given, 3, 3).mean(dim=3)
        self.register_buffer("rotated", rotated, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return features ``(n, out_channels, 1 or 6, V)``."""
        filters = torch.einsum("dcot,otpqyx->dpcqyx", self.weight, self.rotated)
        convolved = conv2d(
            _take(x, self.padded).flatten(3, 4).flatten(1, 2),
            filters.flatten(2, 3).flatten(0, 1),
            self.bias.repeat_interleave(self.returned),
        )
        corners = [x[..., :_CORNERS].mean(dim=2), x[..., self.ring].mean(dim=(2, -1))]
        weights = [self.weight[..., 0].sum(dim=2), self.weight[..., 1:].sum(dim=(2, 3))]
        means = linear(torch.cat(corners, 1).mT, torch.cat(weights, 1), self.bias).mT
        at_corners = means.repeat_interleave(self.returned, dim=1)
        features = torch.cat([at_corners, _take(convolved, self.pixels)], dim=-1)
        return features.reshape(-1, len(self.bias), self.returned, features.shape[-1])


class _Pool(_OnAtlas):
    """Maximum of each vertex that the next coarser level keeps and its neighbors."""

    def forward(self, x: Tensor) -> Tensor:
        """Return ``(n, C, 6, V′)``; at corners, the maximum over orientations too."""
        most = _take(x, self.pooled).amax(dim=3)
        corners = most[..., :_CORNERS].amax(dim=2, keepdim=True).expand(-1, -1, 6, -1)
        return torch.cat([corners, most[..., _CORNERS:]], dim=-1)


class _Unpool(_OnAtlas):
    """The next finer level: new vertices are the mean of two."""

    def forward(self, x: Tensor) -> Tensor:
        """Return ``(n, C, 6, V)``."""
        return torch.cat([x, _take(x, self.parents).mean(dim=3)], dim=-1)


def _unpool(_channels: int, level: int) -> nn.Module:
    return _Unpool(level, "parents")


class _Block(nn.Module):
    """A convolution and a shortcut; orientations share statistics of batch normalization."""

    def __init__(self, in_channels: int, out_channels: int, convolution: Convolution) -> None:
        super().__init__()
        self.body = nn.Sequential(
            convolution(in_channels, out_channels), nn.BatchNorm2d(out_channels)
        )
        self.shortcut = nn.Conv2d(in_channels, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return regular features ``(n, out_channels, 6, V)``."""
        return torch.relu(self.body(x) + self.shortcut(x))


class IcoCNN(ResidualUNet):
    """Residual U-Net of gauge equivariant convolutions (Cohen et al. 2019).

    Its widths, blocks and pooling are assumptions: the article was not available.

    Rotations of the signal by the 60 rotations of the icosahedron rotate its scores. Coarser levels
    have the maximum of each vertex and its neighbors; finer ones are interpolated.

    Args:
        in_channels: Channels of the signal: 3 for RGB, 4 for RGB-D.
        num_classes: Classes K.
        level: Level s of the icosphere, at least the number of `widths` less one.
        widths: Regular channels, of six values each, at level s, s − 1, ….

    Raises:
        SettingError: The number of widths does not fit the level.

    Example:
        >>> sum(p.numel() for p in IcoCNN(4, 13, 5).parameters())
        533973
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        level: int,
        widths: Sequence[int] = (8, 16, 32, 64, 64),
    ) -> None:
        levels = levels_of(widths, level)
        super().__init__(
            in_channels,
            num_classes,
            widths,
            convolutions=[partial(GaugeConv, level=r) for r in levels],
            pools=[_Pool(r, "pooled") for r in levels[:-1]],
            ups=[partial(_unpool, level=r) for r in levels[:-1]],
            block=_Block,
        )
        self.fixed_size = (1, icosphere_count(level))
        self.stem = nn.Sequential(
            GaugeConv(in_channels, widths[0], level, given=1),
            nn.BatchNorm2d(widths[0]),
            nn.ReLU(),
        )
        self.head = GaugeConv(widths[0], num_classes, level, returned=1)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Return scores of every vertex: images ``(B, C, 1, V)``.

        Raises:
            SettingError: The images are not signals on the vertices of the network's level.
        """
        check_size(images.shape[-2:], self, 1, self.fixed_size)
        return super().forward(images)
