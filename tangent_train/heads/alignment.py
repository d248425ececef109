"""Bring the depth of the views of a panorama to one scale.

A depth network estimates each view on its own, up to an error of its scale, or up to an unknown
scale and shift. Views are compared at the directions of an icosphere that two or more of them see,
and one scale (and shift) per view is fitted to all pairs of views at once.

* **Logarithm** (mode `scale`): ``log q_i + a_i`` of a view i, with ``q`` the distance, or the
  disparity along the ray. It is linear in the unknown a.
* **Affine**: ``q_i = (s_i x_i + t_i) f_i``, with the network's output x, and f the length of the
  ray for depth or its inverse for disparity. Because f differs between views, a shift of all views
  is observable. The differences of two views are divided by ``√((q_i² + q_j²) / 2)``: the errors of
  a network are about proportional to its depth or disparity. This noise follows the scales, else
  small scales would always fit better: the trivial solution s = 0, and shrinkage of noisy views
  (total least squares, Golub & Van Loan 1980). It does not follow the shifts, else large shifts
  would fit better. Scales are exponentials, so they are positive.

Both are robust: iteratively reweighted least squares with the weights of a Cauchy distribution
(Holland & Welsch 1977), and the median absolute deviation as the unit of residuals. The unit
shrinks slowly, so that views with a wrong start are not taken for outliers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from torch import Tensor

from tangent_train.checkpoints.kinds import Align, DepthKind
from tangent_train.errors import SettingError
from tangent_train.geometry import icosphere, lonlat_to_equirect, xyz_to_lonlat
from tangent_train.heads.distances import RAY_POWERS, along_rays, is_disparity, is_metric
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.representations.views import Views

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_LEVEL = 5
_PHOTO_POINTS = 2**13
_LEAST_SAMPLES = 8
"""Directions that two views must share to be compared."""
_MOST_PAIRS = 2**16
"""Pairs of samples above which directions are left out, to limit the time."""

_CAUCHY = 2.385
"""Residuals of weight ½, in standard deviations: 95 % efficiency for Gaussian noise."""
_MAD_TO_STD = 1.4826
_SHRINKAGE = 0.7
"""Least ratio of the noise in successive iterations."""
_ITERATIONS, _TOLERANCE = 100, 1e-7
_NO_NOISE, _DAMPING, _NEGLIGIBLE = 1e-10, 1e-8, 1e-30

_CONSTANT = 1e-4
"""Range between the quartiles of a constant view, as a share of its median."""

_SCALE_PRIOR, _SHIFT_PRIOR = 2.0, 1.0
"""Standard deviations of the logarithms of scales, and of shifts in medians of a view, where the
overlap does not determine them."""
_NODES = 5
"""Nodes of a grid of corrections per side."""
_SLOPE_PRIOR, _NODE_PRIOR = 0.1, 0.3
"""Standard deviations of differences of neighboring nodes, and of nodes, in logarithms."""


class ViewSamples(NamedTuple):
    """Output of a network at points of the canvas that its views show.

    Attributes:
        num_views: Number of views.
        view: ``(n,)`` number of the view.
        point: ``(n,)`` number of the point.
        value: ``(n,)`` output, NaN where it is not finite.
        ray_length: ``(n,)`` distance divided by z-depth.
        position: ``(n, 2)`` x to the right and y down in the view, −1 to 1 between its outer pixel
            edges; NaN in views that are neither pinhole images nor crops.
    """

    num_views: int
    view: Indices
    point: Indices
    value: Floats
    ray_length: Floats
    position: Floats

    @classmethod
    def joined(cls, parts: Sequence[ViewSamples]) -> ViewSamples:
        """Return the samples of several sets of views, numbered consecutively."""
        first = np.cumsum([0, *(part.num_views for part in parts)])
        views = np.concatenate([part.view + k for part, k in zip(parts, first, strict=False)])
        rest = (np.concatenate(arrays) for arrays in list(zip(*parts, strict=True))[2:])
        return cls(int(first[-1]), views, *rest)


def sphere_points(shape: tuple[int, int]) -> Indices:
    """Return ``(P, 2)`` rows and columns of the pixels of a panorama at an icosphere's vertices."""
    positions = lonlat_to_equirect(xyz_to_lonlat(icosphere(_LEVEL).vertices), shape)
    columns, rows = np.rint(positions).astype(np.int64).T
    return np.stack([rows.clip(0, shape[0] - 1), columns % shape[1]], axis=-1)


def lattice(shape: tuple[int, int]) -> Indices:
    """Return ``(P, 2)`` rows and columns of a square lattice of about 8,000 pixels."""
    step = max(1.0, (shape[0] * shape[1] / _PHOTO_POINTS) ** 0.5)
    lines = (np.arange(step / 2, side, step).astype(np.int64) for side in shape)
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)


def sample_views(
    outputs: NDArray[np.floating], views: Views, shape: tuple[int, int], points: Indices
) -> ViewSamples:
    """Sample the output of a network at points of the canvas, bilinearly.

    Args:
        outputs: ``(n, h, w)`` output for all views of the set.
        views: The views.
        shape: ``(H, W)`` of the canvas: the panorama or photo.
        points: ``(P, 2)`` rows and columns of the canvas.
    """
    placed, images = views.on_canvas(
        torch.from_numpy(np.ascontiguousarray(outputs))[:, None], shape
    )
    height, width = placed.shape[-2:]
    geometry = images.geometry(shape, None)
    rows, columns = geometry.rows[points[:, 0]].T, geometry.columns[:, points[:, 1]]
    rays = np.stack([rows[0] * columns[0], rows[0] * columns[1], rows[1]])
    u, v, w = np.moveaxis(geometry.matrices @ rays, 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (2 * u / w + 1) / width - 1, (2 * v / w + 1) / height - 1
    view, point = np.nonzero((np.maximum(np.abs(x), np.abs(y)) <= 1) & (w > 0))
    position = np.stack([x[view, point], y[view, point]], axis=-1)
    value = _interpolated(placed[:, 0], view, position)
    lengths, length = torch.from_numpy(views.ray_lengths()), np.ones(len(view))
    if lengths.numel() > 1:
        length = _interpolated(lengths, view % len(lengths), position)
    if images is not views:
        position = np.full_like(position, np.nan)
    return ViewSamples(len(placed), view, point, value, length, position)


def _interpolated(images: Tensor, image: Indices, position: Floats) -> Floats:
    """Return bilinear values ``(n,)`` at positions ``(n, 2)``; NaN where one is not finite."""
    height, width = images.shape[1:]
    u, v = (((position + 1) * (width, height) - 1) / 2).T
    left, top = (
        np.floor(line).clip(0, side - 2).astype(np.int64)
        for line, side in ((u, width), (v, height))
    )
    right, below = (u - left).clip(0, 1), (v - top).clip(0, 1)
    array = images.double().numpy()
    upper = (1 - right) * array[image, top, left] + right * array[image, top, left + 1]
    lower = (1 - right) * array[image, top + 1, left] + right * array[image, top + 1, left + 1]
    values = (1 - below) * upper + below * lower
    return np.where(np.isfinite(values), values, np.nan)


@dataclass(frozen=True)
class AlignmentReport:
    """Facts about an alignment.

    Attributes:
        mode: The correction.
        views: Number of views.
        groups: Number of groups of views that overlap, directly or through others. Each has a
            scale of its own.
        isolated: Views that overlap with no other view.
        empty: Views without a valid value.
        constant: Views with constant output, which got a scale but no shift.
        invalid: Share of samples without a valid value, such as sky.
        outliers: Share of pairs of samples with a robust weight below ½.
        step_before: Median difference of the logarithms of two views at a direction.
        step_after: The same after the alignment.
    """

    mode: Align
    views: int
    groups: int = 0
    isolated: tuple[int, ...] = ()
    empty: tuple[int, ...] = ()
    constant: tuple[int, ...] = ()
    invalid: float = 0.0
    outliers: float = 0.0
    step_before: float | None = None
    step_after: float | None = None


@dataclass(frozen=True)
class Alignment:
    """Corrections of the depth of N views.

    Attributes:
        kind: Kind of the depth, see `depth_of_output`.
        scale: ``(N,)`` factors, larger than 0.
        shift: ``(N,)`` shifts, added after multiplication with the scale.
        grid: ``(N, k, k)`` corrections of the logarithm, added bilinearly; rows from top to bottom.
            None without them.
        report: Facts about the alignment.
    """

    kind: DepthKind
    scale: Floats
    shift: Floats
    grid: Floats | None
    report: AlignmentReport

    def applied(self, outputs: Tensor, part: slice, ray_lengths: Tensor) -> Tensor:
        """Return corrected depth in the quantity in which views are blended, see `along_rays`.

        Sky (disparity 0) and negative disparities become 0.

        Args:
            outputs: ``(n, 1, h, w)`` depth of the kind.
            part: The views.
            ray_lengths: ``(1 or n, h, w)``, see `Views.ray_lengths`.
        """
        scale, shift = (
            torch.from_numpy(numbers[part]).to(outputs)[:, None, None, None]
            for numbers in (self.scale, self.shift)
        )
        values = along_rays(outputs * scale + shift, self.kind, ray_lengths.to(outputs)[:, None])
        if is_disparity(self.kind):
            values = values.where(outputs != 0, 0).clamp(min=0)
        if self.grid is None:
            return values
        rows, columns = (
            torch.from_numpy(_hat((2 * np.arange(side) + 1) / side - 1)).to(outputs)
            for side in outputs.shape[-2:]
        )
        added = rows @ torch.from_numpy(self.grid[part]).to(outputs)[:, None] @ columns.T
        return values * added.exp() if is_disparity(self.kind) else values + added


def align_views(
    parts: Sequence[ViewSamples], kind: DepthKind, mode: Align | None = None
) -> Alignment:
    """Fit corrections of views to each other.

    Distances in the median view of each group of overlapping views keep their median, so that
    metric depth remains metric.

    Args:
        parts: Samples of all sets of views.
        kind: Kind of the values, see `depth_of_output`.
        mode: The correction; None for `scale` of metric and `affine` of relative kinds, to which
            `grid` adds a grid of corrections. A single view is not corrected.

    Raises:
        SettingError: The mode is unknown, or `grid` is given for views without positions.
    """
    check_choice("align", mode or "none", get_args(Align))
    samples = ViewSamples.joined(parts)
    view, count, value = samples.view, samples.num_views, samples.value
    usual: Align = "scale" if is_metric(kind) else "affine"
    mode = (mode or usual) if count > 1 else "none"
    if mode == "grid" and np.isnan(samples.position).any():
        expected = "none, scale or affine, for views that are not pinhole images"
        raise SettingError("align", found="grid", expected=expected)
    base = usual if mode == "grid" else mode
    factor = samples.ray_length ** RAY_POWERS[kind]
    is_valid = np.isfinite(value) & (value != 0 if base == "affine" else value > 0)
    value = np.where(is_valid, value, np.nan)
    before, pairs = _logarithm(value * factor), _pairs(samples, np.flatnonzero(is_valid))
    scale, shift, grid = np.ones(count), np.zeros(count), None
    outliers, is_constant = np.zeros(0, bool), np.zeros(count, bool)
    if base == "scale" and len(pairs.a):
        scale, outliers = _fit_scales(pairs, before, count)
    elif base == "affine" and len(pairs.a):
        scale, shift, is_constant, outliers = _fit_affine(pairs, value, factor, view, count)
    links = sparse.coo_array((np.ones(len(pairs.a)), (pairs.a, pairs.b)), (count, count))
    groups: Indices = connected_components(links, directed=False)[1]
    after, changes = _logarithm((scale[view] * value + shift[view]) * factor), np.zeros(count)
    for number in np.unique(view[np.isfinite(after - before)]):
        changes[number] = np.nanmedian((after - before)[view == number])
    unit = _medians(changes, groups)
    scale, shift, after = scale / np.exp(unit), shift / np.exp(unit), after - unit[view]
    if mode == "grid" and len(pairs.a):
        grid, added, outliers = _fit_grid(pairs, after, samples)
        grid -= _medians(grid.mean(axis=(1, 2)), groups)[:, None, None]
        after = after + added
    is_empty = np.bincount(view[is_valid], minlength=count) == 0
    alone = (np.bincount(groups)[groups] == 1) & ~is_empty & (count > 1)
    report = AlignmentReport(
        mode,
        count,
        groups=len(np.unique(groups[~is_empty])),
        isolated=tuple(np.flatnonzero(alone).tolist()),
        empty=tuple(np.flatnonzero(is_empty).tolist()),
        constant=tuple(np.flatnonzero(is_constant).tolist()),
        invalid=1 - float(is_valid.mean()) if len(view) else 0.0,
        outliers=float(outliers.mean()) if len(outliers) else 0.0,
        step_before=pairs.step(before),
        step_after=pairs.step(after),
    )
    return Alignment(kind, scale, shift, grid, report)


def _medians(values: Floats, groups: Indices) -> Floats:
    """Return the median of the group of each value."""
    return np.array([np.median(values[groups == k]) for k in range(groups.max() + 1)])[groups]


def _logarithm(values: Floats) -> Floats:
    """Return logarithms; NaN of values that are not positive."""
    return np.log(np.where(values > 0, values, np.nan))


class _Pairs(NamedTuple):
    """Pairs of samples of the same point in two views.

    Attributes:
        first: ``(m,)`` indices of samples.
        second: ``(m,)`` indices of the samples in the other view.
        a: ``(m,)`` view of the first.
        b: ``(m,)`` view of the second.
    """

    first: Indices
    second: Indices
    a: Indices
    b: Indices

    def step(self, logs: Floats) -> float | None:
        """Return the median difference of logarithms."""
        steps = np.abs(logs[self.first] - logs[self.second])
        return float(np.nanmedian(steps)) if np.isfinite(steps).any() else None


def _pairs(samples: ViewSamples, valid: Indices) -> _Pairs:
    """Pair valid samples of the same point, of all views that share enough points."""
    shared = np.bincount(samples.point[valid])
    every = max(1, -(-int((shared * (shared - 1) // 2).sum()) // _MOST_PAIRS))
    valid = valid[samples.point[valid] % every == 0]
    order = valid[np.argsort(samples.point[valid], kind="stable")]
    point, pairs = samples.point[order], [np.empty((2, 0), np.int64)]
    for step in range(1, samples.num_views):
        same = np.flatnonzero(point[step:] == point[:-step])
        if not len(same):
            break
        pairs.append(np.stack([order[same], order[same + step]]))
    first, second = np.concatenate(pairs, axis=1)
    a, b = samples.view[first], samples.view[second]
    views = np.minimum(a, b) * samples.num_views + np.maximum(a, b)
    _, number, counts = np.unique(views, return_inverse=True, return_counts=True)
    kept = counts[number] >= _LEAST_SAMPLES
    return _Pairs(first[kept], second[kept], a[kept], b[kept])


def _slopes(entries: Sequence[Floats], unknowns: Sequence[Indices], count: int) -> sparse.csr_array:
    """Return the ``(m, count)`` matrix with k entries in each row, at the numbers of unknowns."""
    values, columns = np.stack(entries, axis=-1), np.stack(unknowns, axis=-1)
    starts = np.arange(0, values.size + 1, len(entries))
    return sparse.csr_array((values.ravel(), columns.ravel(), starts), (len(values), count))


def _robust_fit(
    evaluate: Callable[[Floats], tuple[Floats, sparse.csr_array]],
    start: Floats,
    prior: sparse.csr_array | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Minimize the Cauchy loss of residuals, in units of their median absolute deviation.

    Gauss-Newton steps on reweighted squares. Priors are measured in the noise of the residuals:
    they decide what the samples do not determine, and vanish without noise.

    Args:
        evaluate: Returns residuals ``(m,)`` and their derivatives ``(m, n)``.
        start: ``(n,)`` first values of the unknowns.
        prior: ``(k, n)`` matrix; its product with the unknowns is expected to be that with `start`,
            with a standard deviation of 1.

    Returns:
        The unknowns, and a mask of residuals with a weight below ½.
    """
    unknowns, weight, noise = start, np.ones(0), _NO_NOISE
    for _ in range(_ITERATIONS):
        residual, slopes = evaluate(unknowns)
        spread = _MAD_TO_STD * float(np.median(np.abs(residual)))
        noise = max(spread, _SHRINKAGE * noise, _NO_NOISE)
        weight = 1 / (1 + (residual / (_CAUCHY * noise)) ** 2)
        weighted = slopes.T @ sparse.diags_array(weight)
        normal, slope = weighted @ slopes, weighted @ residual
        if prior is not None:
            normal += noise**2 * prior.T @ prior
            slope += noise**2 * prior.T @ (prior @ (unknowns - start))
        normal += sparse.diags_array(_DAMPING * normal.diagonal() + _NEGLIGIBLE)
        step = spsolve(normal.tocsc(), -slope)
        unknowns = unknowns + step.clip(-1, 1)
        if np.abs(step).max() < _TOLERANCE:
            break
    return unknowns, weight < 1 / 2


def _fit_scales(pairs: _Pairs, logs: Floats, count: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return scales ``(N,)``, and a mask of outliers."""
    ones, offset = np.ones(len(pairs.a)), logs[pairs.first] - logs[pairs.second]
    slopes = _slopes([ones, -ones], [pairs.a, pairs.b], count)
    fit, outliers = _robust_fit(lambda x: (slopes @ x + offset, slopes), np.zeros(count))
    return np.exp(fit), outliers


def _fit_affine(
    pairs: _Pairs, value: Floats, factor: Floats, view: Indices, count: int
) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return scales and shifts ``(N,)``, a mask of constant views, and a mask of outliers.

    The unknowns are u and b in ``s x + t = exp(u) (x / unit + b)``.
    """
    first, second, a, b = pairs
    unit, is_constant = np.ones(count), np.zeros(count, bool)
    used = np.unique(np.concatenate([first, second]))
    for number in np.unique(view[used]):
        low, middle, high = np.quantile(value[used[view[used] == number]], (0.25, 0.5, 0.75))
        unit[number] = max(high - low, abs(middle))
        is_constant[number] = high - low <= _CONSTANT * abs(middle)
    normal, has_shift = value / unit[view], ~is_constant

    def evaluate(unknowns: Floats) -> tuple[Floats, sparse.csr_array]:
        scale, shift = np.exp(unknowns[:count]), unknowns[count:]
        depth = scale[view] * (normal + shift[view]) * factor
        noise = np.hypot(depth[first], depth[second]) / 2**0.5 + _NEGLIGIBLE
        residual, share = (depth[first] - depth[second]) / noise, (depth[first] / noise) ** 2 / 2
        entries = [
            depth[first] / noise - residual * share,
            -depth[second] / noise - residual * (1 - share),
            scale[a] * factor[first] / noise * has_shift[a],
            -scale[b] * factor[second] / noise * has_shift[b],
        ]
        return residual, _slopes(entries, [a, b, count + a, count + b], 2 * count)

    prior = sparse.diags_array(np.repeat([1 / _SCALE_PRIOR, 1 / _SHIFT_PRIOR], count)).tocsr()
    start = np.concatenate([np.log(unit), np.zeros(count)])
    fit, outliers = _robust_fit(evaluate, start, prior)
    scale = np.exp(fit[:count])
    return scale / unit, scale * fit[count:], is_constant, outliers


def _fit_grid(
    pairs: _Pairs, logs: Floats, samples: ViewSamples
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return corrections ``(N, k, k)``, their values at the samples, and a mask of outliers."""
    count, nodes = samples.num_views, _NODES**2
    x, y = (_hat(samples.position[:, axis]) for axis in (0, 1))
    hats = sparse.csr_array((y[:, :, None] * x[:, None, :]).reshape(-1, nodes)).tocoo()
    columns = samples.view[hats.row] * nodes + hats.col
    at_samples = sparse.csr_array((hats.data, (hats.row, columns)), (len(x), count * nodes))
    comparable = np.isfinite(logs[pairs.first] - logs[pairs.second])
    first, second = pairs.first[comparable], pairs.second[comparable]
    slopes, offset = at_samples[first] - at_samples[second], logs[first] - logs[second]
    one = sparse.eye_array(_NODES)
    next_node = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(_NODES - 1, _NODES))
    smooth = sparse.vstack([sparse.kron(one, next_node), sparse.kron(next_node, one)])
    small = sparse.vstack([smooth / _SLOPE_PRIOR, sparse.eye_array(nodes) / _NODE_PRIOR])
    prior = sparse.kron(sparse.eye_array(count), small).tocsr()
    start = np.zeros(count * nodes)
    fit, outliers = _robust_fit(lambda x: (slopes @ x + offset, slopes), start, prior)
    return fit.reshape(count, _NODES, _NODES), at_samples @ fit, outliers


def _hat(positions: Floats) -> Floats:
    """Return weights ``(n, k)`` of linear interpolation between the nodes of a grid.

    Args:
        positions: ``(n,)`` from −1 (the first node) to 1 (the last).
    """
    nodes = np.linspace(-1, 1, _NODES)
    distance = np.abs(positions[:, None] - nodes) * (_NODES - 1) / 2
    return np.maximum(0, 1 - distance)
