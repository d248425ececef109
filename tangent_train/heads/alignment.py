"""Bring the depth of the views of a panorama to one scale, and blend them.

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

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from torch import Tensor
from torch.nn.functional import grid_sample

from tangent_train.errors import SettingError
from tangent_train.geometry import icosphere, lonlat_to_equirect, ray_lengths, xyz_to_lonlat
from tangent_train.geometry.sphere import Floats
from tangent_train.kinds import Align, DepthKind, depth_channels
from tangent_train.rendering import Blend
from tangent_train.rendering.mosaic import MeanMosaic
from tangent_train.rendering.representations.views import Views
from tangent_train.rendering.tensors import on_device

Indices = NDArray[np.int64]

RAY_POWERS: dict[str, int] = {
    "metric_distance": 0,
    "metric_z": 1,
    "relative_z": 1,
    "relative_depth": 1,
    "relative_disparity": -1,
}
"""Powers of the ray length that convert depth, or disparity, to that along the ray."""

_SHIFTED = "relative_depth", "relative_disparity"
"""Kinds with an unknown shift of each view."""

_FARTHEST_M = 1e4
_FARTHEST = 100.0
"""Multiples of the median beyond which relative depth is unknown, like sky: small errors of the
disparity change it without limit."""

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


def is_disparity(kind: DepthKind) -> bool:
    """Return True if views are blended in disparity, False if in the logarithm of distance."""
    return kind == "relative_disparity"


def is_metric(kind: DepthKind) -> bool:
    """Return True if distances are in meters, False if only their ratios are known."""
    return not kind.startswith("relative")


def depth_of_output(
    output: Tensor, kind: DepthKind, ray_lengths: Tensor
) -> tuple[Tensor, DepthKind]:
    """Convert `log_distance` and canonical depth to meters, and points to z-depth.

    Other kinds are returned unchanged.

    Canonical depth is multiplied by the focal length in image widths (Yin et al. 2023), its inverse
    divided by it (Bochkovskii et al. 2024, section 3.2). That follows from the rays: at columns of
    distance d, the second difference of 1 + x² is 2 (d p)², with the pitch p of pixels on the image
    plane. From the inverse, depth is at most 10 km, as in the authors' code.

    A point at distance ρ from the optical axis has the z-depth z + t with ρ = q (z + t), where q =
    √(x² + y²) is known at its pixel (x, y) on the image plane at distance 1. The shift t of an
    image follows by least squares, independently of its scale.

    Args:
        output: Output of a network for whole images, ``(n, depth_channels(kind), h, w)``.
        kind: Kind of the output.
        ray_lengths: ``(1 or n, 1, h, w)``, see `Views.ray_lengths`.

    Returns:
        Depth, and its kind, which is in `RAY_POWERS`.
    """
    if kind == "log_distance":
        return output.exp(), "metric_distance"
    if kind == "canonical_z":
        return output / _span(ray_lengths), "metric_z"
    if kind == "canonical_inverse":
        inverse = output.where(output.isfinite(), torch.nan) * _span(ray_lengths)
        return 1 / inverse.clamp(1 / _FARTHEST_M, _FARTHEST_M), "metric_z"
    if kind == "relative_points":
        z, off_axis = output[:, 2:], output[:, :2].norm(dim=1, keepdim=True)
        q = (ray_lengths.square() - 1).clamp(min=0).sqrt().expand_as(z)
        known = (z + off_axis).isfinite()
        shift = (q * (off_axis - q * z)).where(known, 0).sum(dim=(1, 2, 3), keepdim=True)
        squares = q.square().where(known, 0).sum(dim=(1, 2, 3), keepdim=True)
        return z + shift / squares.clamp(min=_NEGLIGIBLE), "relative_z"
    return output, kind


def _span(ray_lengths: Tensor) -> Any:
    """Return the width of images ``(…, h, w)`` on the image plane at distance 1."""
    width = ray_lengths.shape[-1]
    if width == 1:  # not a pinhole image: the radians of an equirectangular image
        return 2 * math.pi
    half = (width - 1) // 2
    left, middle, right = ray_lengths[..., [0, half, 2 * half]].square().unbind(-1)
    squared = ((left + right) / 2 - middle).mean(-1)[..., None, None]
    return squared.sqrt() * width / half


def along_rays(depth: Tensor, kind: DepthKind, ray_lengths: Tensor) -> Tensor:
    """Convert depth to the quantity in which views are blended.

    Args:
        depth: Values of the kind.
        kind: Kind of the values, see `depth_of_output`.
        ray_lengths: Distance divided by z-depth at each pixel, see `Views.ray_lengths`.

    Returns:
        Disparity along the ray, 1 / distance, for `relative_disparity`; for other kinds the natural
        logarithm of the distance. NaN where the depth is not finite, or not positive where its
        logarithm is taken.
    """
    values = depth * ray_lengths ** RAY_POWERS[kind]
    values = values if is_disparity(kind) else values.log()
    return values.where(values.isfinite(), torch.nan)


def from_distance(distance: Tensor, kind: DepthKind, ray_lengths: Tensor) -> Tensor:
    """Convert distances along the rays to the output of a network: the inverse of `distance_of`.

    Args:
        distance: Distances ``(n, …, h, w)``.
        kind: Kind of the result.
        ray_lengths: Distance divided by z-depth at each pixel, see `Views.ray_lengths`.

    Raises:
        SettingError: The output is points, with which no network is trained.
    """
    if kind == "relative_points":
        expected = "a network that returns one value per pixel, to train it"
        raise SettingError("depth_kind", found=kind, expected=expected)
    if kind == "log_distance":
        return distance.log()
    if kind == "canonical_z":
        return distance / ray_lengths * _span(ray_lengths)
    if kind == "canonical_inverse":
        return ray_lengths / (distance * _span(ray_lengths))
    values = 1 / distance if is_disparity(kind) else distance
    return values * ray_lengths ** -RAY_POWERS[kind]


def distance_of(values: Tensor, kind: DepthKind) -> Tensor:
    """Convert blended values, see `along_rays`, to distances; NaN where disparity is ≤ 0."""
    if not is_disparity(kind):
        return values.exp()
    return (1 / values).where(values > 0, torch.nan)


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
    outputs: Tensor, views: Views, shape: tuple[int, int], points: Indices
) -> ViewSamples:
    """Sample the output of a network at points of the canvas, bilinearly.

    Args:
        outputs: ``(n, 1, h, w)`` output for all views of the set; only samples leave its device.
        views: The views.
        shape: ``(H, W)`` of the canvas: the panorama or photo.
        points: ``(P, 2)`` rows and columns of the canvas.
    """
    placed, images = views.on_canvas(outputs, shape)
    height, width = placed.shape[-2:]
    geometry = images.geometry(shape, None)
    rows, columns = geometry.rows[points[:, 0]].T, geometry.columns[:, points[:, 1]]
    rays = np.stack([rows[0] * columns[0], rows[0] * columns[1], rows[1]])
    u, v, w = np.moveaxis(geometry.matrices @ rays, 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        positions = (2 * np.stack([u, v], axis=-1) / w[..., None] + 1) / (width, height) - 1
    is_shown = (np.abs(positions).max(axis=-1) <= 1) & (w > 0)
    view, point = np.nonzero(is_shown)
    position = positions[is_shown]
    positions[~is_shown] = 0
    value = _bilinear(placed, positions)[is_shown]
    lengths = _bilinear(torch.from_numpy(views.ray_lengths()[:, None]), positions)[is_shown]
    value = np.where(np.isfinite(value), value, np.nan)
    position = position if images is views else np.full_like(position, np.nan)
    return ViewSamples(len(placed), view, point, value, lengths, position)


def _bilinear(images: Tensor, positions: Floats) -> Floats:
    """Return values ``(n, P)`` of images ``(1 or n, 1, h, w)`` at positions ``(n, P, 2)``."""
    at = torch.from_numpy(positions[:, None].astype(np.float32)).to(images)
    images = images.expand(len(positions), -1, -1, -1)
    values = grid_sample(images, at, padding_mode="border", align_corners=False)
    return np.asarray(values.cpu().numpy()[:, 0, 0], np.float64)


class Alignment(NamedTuple):
    """Corrections of the depth of N views.

    Attributes:
        kind: Kind of the depth, see `depth_of_output`.
        scale: ``(N,)`` factors, larger than 0.
        shift: ``(N,)`` shifts, added after multiplication with the scale.
        grid: ``(N, k, k)`` corrections of the logarithm, added bilinearly; rows from top to bottom.
            None without them.
        facts: Facts for summaries: the correction (``mode``); numbers of ``views``, of ``groups``
            that overlap, directly or through others, and have a scale of their own, of ``isolated``
            views that overlap with no other view, of ``empty`` ones without a valid value, and of
            ``constant`` ones, which got a scale but no shift; ``step_before`` and ``step_after``,
            the median difference of the logarithms of two views at a direction.
    """

    kind: DepthKind
    scale: Floats
    shift: Floats
    grid: Floats | None
    facts: dict[str, Any]

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
        mode: The correction; None for `affine` of kinds with an unknown shift and `scale` of
            others, to which `grid` adds a grid of corrections. A single view is not corrected.

    Raises:
        SettingError: `grid` is given for views without positions.
    """
    samples = ViewSamples.joined(parts)
    view, count, value = samples.view, samples.num_views, samples.value
    usual: Align = "affine" if kind in _SHIFTED else "scale"
    mode = (mode or usual) if count > 1 else "none"
    if mode == "grid" and np.isnan(samples.position).any():
        expected = "none, scale or affine, for views that are not pinhole images"
        raise SettingError("align", found="grid", expected=expected)
    base = usual if mode == "grid" else mode
    factor = samples.ray_length ** RAY_POWERS[kind]
    is_valid = np.isfinite(value) & (value != 0 if base == "affine" else value > 0)
    value = np.where(is_valid, value, np.nan)
    before, (first, second) = _logarithm(value * factor), _pairs(samples, is_valid)
    pairs = first, second, view[first], view[second]
    scale, shift, grid, is_constant = np.ones(count), np.zeros(count), None, np.zeros(count, bool)
    if base == "scale" and len(first):
        scale = _fit_scales(pairs, before, count)
    elif base == "affine" and len(first):
        scale, shift, is_constant = _fit_affine(pairs, value, factor, view, count)
    links = sparse.coo_array((np.ones(len(first)), pairs[2:]), (count, count))
    groups: Indices = connected_components(links, directed=False)[1]
    after = _logarithm((scale[view] * value + shift[view]) * factor)
    unit = _medians(_medians(after - before, view, count), groups, count)[groups]
    scale, shift, after = scale / np.exp(unit), shift / np.exp(unit), after - unit[view]
    if mode == "grid" and len(first):
        grid, added = _fit_grid(pairs, after, samples)
        grid -= _medians(grid.mean(axis=(1, 2)), groups, count)[groups, None, None]
        after = after + added
    is_empty = np.bincount(view[is_valid], minlength=count) == 0
    is_alone = (np.bincount(groups)[groups] == 1) & ~is_empty & (count > 1)
    steps = [np.abs(logs[first] - logs[second]) for logs in (before, after)]
    step_before, step_after = (
        float(np.nanmedian(step)) if np.isfinite(step).any() else None for step in steps
    )
    facts = {
        "mode": mode,
        "views": count,
        "groups": len(np.unique(groups[~is_empty])),
        "isolated": int(is_alone.sum()),
        "empty": int(is_empty.sum()),
        "constant": int(is_constant.sum()),
        "step_before": step_before,
        "step_after": step_after,
    }
    return Alignment(kind, scale, shift, grid, facts)


def _medians(values: Floats, numbers: Indices, count: int) -> Floats:
    """Return the medians ``(count,)`` of the finite values of each number; 0 without any."""
    known = [values[(numbers == k) & np.isfinite(values)] for k in range(count)]
    return np.array([np.median(part) if len(part) else 0.0 for part in known])


def _logarithm(values: Floats) -> Floats:
    """Return logarithms; NaN of values that are not positive."""
    return np.log(np.where(values > 0, values, np.nan))


_Pairs = tuple[Indices, Indices, Indices, Indices]
"""Indices ``(m,)`` of samples, those of a sample of the same point in another view each, and the
views of both."""


def _pairs(samples: ViewSamples, is_valid: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Pair valid samples of the same point, of all views that share enough points."""
    valid = np.flatnonzero(is_valid)
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
    is_kept = counts[number] >= _LEAST_SAMPLES
    return first[is_kept], second[is_kept]


def matrix_rows(
    entries: Sequence[Floats], unknowns: Sequence[Indices], count: int
) -> sparse.csr_array:
    """Return the ``(m, count)`` matrix with k entries in each row, at the numbers of unknowns."""
    values, columns = np.stack(entries, axis=-1), np.stack(unknowns, axis=-1)
    starts = np.arange(0, values.size + 1, len(entries))
    return sparse.csr_array((values.ravel(), columns.ravel(), starts), (len(values), count))


def robust_fit(
    evaluate: Callable[[Floats], tuple[Floats, sparse.csr_array]],
    start: Floats,
    prior: sparse.csr_array | None = None,
) -> Floats:
    """Minimize the Cauchy loss of residuals, in units of their median absolute deviation.

    Gauss-Newton steps on reweighted squares. Priors are measured in the noise of the residuals:
    they decide what the samples do not determine, and vanish without noise.

    Args:
        evaluate: Returns residuals ``(m,)`` and their derivatives ``(m, n)``.
        start: ``(n,)`` first values of the unknowns.
        prior: ``(k, n)`` matrix; its product with the unknowns is expected to be that with `start`,
            with a standard deviation of 1.
    """
    unknowns, noise = start, _NO_NOISE
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
    return unknowns


def _fit_scales(pairs: _Pairs, logs: Floats, count: int) -> Floats:
    """Return scales ``(N,)``."""
    first, second, a, b = pairs
    ones, offset = np.ones(len(a)), logs[first] - logs[second]
    slopes = matrix_rows([ones, -ones], [a, b], count)
    return np.exp(robust_fit(lambda x: (slopes @ x + offset, slopes), np.zeros(count)))


def _fit_affine(
    pairs: _Pairs, value: Floats, factor: Floats, view: Indices, count: int
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return scales and shifts ``(N,)``, and a mask of constant views.

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
        return residual, matrix_rows(entries, [a, b, count + a, count + b], 2 * count)

    prior = sparse.diags_array(np.repeat([1 / _SCALE_PRIOR, 1 / _SHIFT_PRIOR], count)).tocsr()
    fit = robust_fit(evaluate, np.concatenate([np.log(unit), np.zeros(count)]), prior)
    scale = np.exp(fit[:count])
    return scale / unit, scale * fit[count:], is_constant


def _fit_grid(pairs: _Pairs, logs: Floats, samples: ViewSamples) -> tuple[Floats, Floats]:
    """Return corrections ``(N, k, k)``, and their values at the samples."""
    count, nodes = samples.num_views, _NODES**2
    x, y = (_hat(samples.position[:, axis]) for axis in (0, 1))
    hats = sparse.csr_array((y[:, :, None] * x[:, None, :]).reshape(-1, nodes)).tocoo()
    columns = samples.view[hats.row] * nodes + hats.col
    at_samples = sparse.csr_array((hats.data, (hats.row, columns)), (len(x), count * nodes))
    is_comparable = np.isfinite(logs[pairs[0]] - logs[pairs[1]])
    first, second = (part[is_comparable] for part in pairs[:2])
    slopes, offset = at_samples[first] - at_samples[second], logs[first] - logs[second]
    one = sparse.eye_array(_NODES)
    next_node = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(_NODES - 1, _NODES))
    smooth = sparse.vstack([sparse.kron(one, next_node), sparse.kron(next_node, one)])
    small = sparse.vstack([smooth / _SLOPE_PRIOR, sparse.eye_array(nodes) / _NODE_PRIOR])
    prior = sparse.kron(sparse.eye_array(count), small).tocsr()
    start = np.zeros(count * nodes)
    fit = robust_fit(lambda x: (slopes @ x + offset, slopes), start, prior)
    return fit.reshape(count, _NODES, _NODES), at_samples @ fit


def _hat(positions: Floats) -> Floats:
    """Return weights ``(n, k)`` of linear interpolation between the nodes of a grid.

    Args:
        positions: ``(n,)`` from −1 (the first node) to 1 (the last).
    """
    nodes = np.linspace(-1, 1, _NODES)
    distance = np.abs(positions[:, None] - nodes) * (_NODES - 1) / 2
    return np.maximum(0, 1 - distance)


class AlignedMosaic:
    """Distances along the rays of a panorama or photo, whose views are aligned, then blended.

    Views are blended in the logarithm of distance, or in disparity for networks that return it. A
    confidence is a factor of their weights; pixels of confidence 0 are unknown.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        kind: Kind of the network's output.
        blend: Blend of the views.
        align: See `align_views`.
        valid: ``(H, W)`` valid pixels of a partial panorama, at which views are compared; None if
            all are valid.
        camera_matrix: ``(3, 3)`` K of a photo; None for a panorama.

    Attributes:
        facts: Facts about the alignment, after `pixels` or `distances`, see `Alignment`.
    """

    facts: dict[str, Any]

    def __init__(
        self,
        shape: tuple[int, int],
        kind: DepthKind,
        blend: Blend,
        align: Align | None = None,
        *,
        valid: NDArray[np.bool_] | None = None,
        camera_matrix: NDArray[np.float64] | None = None,
    ) -> None:
        self._shape, self._kind, self._align = shape, kind, align
        self._blend: Blend = blend
        self._lengths = None if camera_matrix is None else ray_lengths(camera_matrix, shape)
        points = sphere_points(shape) if camera_matrix is None else lattice(shape)
        self._points = points if valid is None else points[valid[tuple(points.T)]]
        self.facts = {}
        self._parts: list[Tensor] = []
        self._sets: list[tuple[Views, Tensor]] = []

    def add(self, outputs: Tensor, views: Views) -> None:
        """Add the next views of a set; sets must be complete.

        Args:
            outputs: Outputs of the network ``(n, C, h, w)``: `depth_channels` of its kind, and
                optionally a confidence.
            views: The views.
        """
        self._parts.append(outputs)
        if sum(map(len, self._parts)) == views.num_images:
            self._sets.append((views.whole, torch.cat(self._parts)))
            self._parts.clear()

    def distances(self) -> Tensor:
        """Return distances ``(H, W)`` from the center along the rays, NaN where unknown.

        They are in meters, or for relative kinds in multiples of the median of known distances, of
        a photo of z-depth, by solid angle.

        Raises:
            SettingError: The views cannot be aligned in this way.
        """
        device, channels = self._sets[0][1].device, depth_channels(self._kind)
        is_weighted = self._sets[0][1].shape[1] > channels
        all_lengths = [on_device(views.ray_lengths(), device) for views, _ in self._sets]
        depths, confidences = [], [outputs[:, channels:] for _, outputs in self._sets]
        for (_, outputs), lengths, weight in zip(self._sets, all_lengths, confidences, strict=True):
            values = outputs[:, :channels]
            depth, kind = depth_of_output(values, self._kind, lengths.to(values)[:, None])
            depths.append(depth.where(weight > 0, torch.nan) if is_weighted else depth)
        samples = [
            sample_views(depth, views, self._shape, self._points)
            for (views, _), depth in zip(self._sets, depths, strict=True)
        ]
        alignment = align_views(samples, kind, self._align)
        finite = torch.cat([outputs.isfinite().flatten() for _, outputs in self._sets])
        share = 1 - float(finite.double().mean())
        self.facts |= alignment.facts | ({"not_finite": share} if share else {})
        mosaic, first = MeanMosaic(self._shape, self._blend, 1 + is_weighted, device=device), 0
        parts = zip(self._sets, depths, all_lengths, confidences, strict=True)
        for (views, _), depth, lengths, weight in parts:
            part = slice(first, first + len(views))
            values = alignment.applied(depth, part, lengths)
            mosaic.add(torch.cat([values * weight, weight], 1) if is_weighted else values, views)
            first = part.stop
        blended, *weights = mosaic.values()
        distance = distance_of(blended / weights[0] if is_weighted else blended, kind)
        if not is_metric(self._kind):
            distance = distance / self._median(distance)
            distance = distance.where(distance <= _FARTHEST, torch.nan)
            distance = distance / self._median(distance)  # without what was too far
        return distance

    def pixels(self) -> Tensor:
        """Return what users get: z-depth of a photo, distances of a panorama."""
        distance = self.distances()
        if self._lengths is None:
            return distance
        return distance / torch.from_numpy(self._lengths).to(distance)

    def _median(self, distance: Tensor) -> float:
        """Return the median of known depth at points, by solid angle; 1 if all are unknown."""
        points = tuple(self._points.T)
        index = on_device(np.ravel_multi_index(points, self._shape), distance.device)
        values = distance.flatten().index_select(0, index).cpu().numpy()
        lengths = np.ones(len(values)) if self._lengths is None else self._lengths[points]
        known = np.isfinite(values)
        if not known.any():
            return 1.0
        weights, values = lengths[known] ** -3.0, (values / lengths)[known]
        return float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))
