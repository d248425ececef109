"""Objects of a panorama, put together from the objects of its views.

A chair in two views is one chair. Masks of two views are compared at the directions that both views
see, where they must agree, whatever the border of an image cuts off. Pairs of one class join in the
order of their overlap, unless the result had two masks of one view: a network that draws two masks
in an image sees two objects. Objects that are larger than a view, cross ±180° or a pole need no
rule of their own.

At each pixel of the panorama, the views vote with the weights of feathering. An object has the mean
score of its masks, "no object" the score 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from models.segments import Segments
from tangent_train.geometry import (
    equirect_directions,
    equirect_solid_angles,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.rendering import kernels
from tangent_train.rendering.representations.views import Views

Numbers = NDArray[np.int32]

LEAST_OVERLAP = 0.5
"""Intersection over union, at the directions that two views see, from which masks join."""

_ROWS = 512
"""Rows of the canvas on which masks are compared, at most."""

_LEAST_SHARE = 0.5
"""Part of its masks that an object must win, else it is left out."""

_NOTHING = 1e-12

_LEAST_SR = 1e-5
"""Solid angle of the smallest object, in steradians: a disc of 0.2°."""


_BOX = "longitude_deg", "latitude_deg", "width_deg", "height_deg"
_STEPS = 3
"""Steps in which the center of a spherical box moves from the mean direction to its middle."""


class Objects(NamedTuple):
    """Objects of a panorama or photo.

    Attributes:
        numbers: ``(H, W)`` int32 number of the object at each pixel, from 1; 0 for none.
        classes: ``(n,)`` index of the class of each object.
        scores: ``(n,)`` confidence of each object, 0 to 1: the mean of its masks by solid angle.
    """

    numbers: NDArray[np.int32]
    classes: NDArray[np.int64]
    scores: NDArray[np.float64]


def join_objects(
    sets: Sequence[tuple[Views, Sequence[Segments]]],
    shape: tuple[int, int],
    least_overlap: float = LEAST_OVERLAP,
) -> Objects:
    """Put together the objects of a panorama or photo.

    Args:
        sets: Sets of views, pinhole images or crops of one size, and the objects of each view.
        shape: ``(H, W)`` of the panorama or photo.
        least_overlap: See `LEAST_OVERLAP`.
    """
    segments = [of_view for _, of_views in sets for of_view in of_views]
    first = np.cumsum([0, *(len(of_view.scores) for of_view in segments)])
    classes, scores = (
        np.concatenate([getattr(of_view, name).cpu().numpy() for of_view in segments])
        for name in ("classes", "scores")
    )
    numbers = np.stack([of_view.numbers.cpu().numpy() for of_view in segments])
    numbers = np.where(numbers > 0, numbers + first[:-1, None, None], 0)
    rows = min(shape[0], _ROWS)
    small = rows, round(rows * shape[1] / shape[0])
    masks, seen = _incidence(numbers, _geometry(sets, small), small, len(classes))
    view = np.repeat(np.arange(len(segments)), np.diff(first))
    group = _groups(masks, seen, view, classes, least_overlap)
    area = masks.sum(axis=1)
    total = np.bincount(group, area)
    of_group = np.bincount(group, area * scores) / np.maximum(total, _NOTHING)
    class_of = np.zeros(len(total), np.int64)
    class_of[group] = classes
    winners = np.zeros(shape, np.int32)
    table = np.append(0, group + 1).astype(np.int32)[numbers]
    votes = np.append(1, of_group).astype(np.float32)
    kernels.over_rows(kernels.vote, *shape, table, _geometry(sets, shape), votes, winners)
    of_masks = np.ones(len(group)), (group, np.arange(len(group)))
    in_groups = sparse.csr_array(of_masks, (len(total), len(group)))
    covered = (in_groups @ masks).astype(bool) @ _pixel_weights(small).ravel()
    return _kept(Objects(winners, class_of, of_group), covered)


def _geometry(sets: Sequence[tuple[Views, Any]], shape: tuple[int, int]) -> kernels.CanvasGeometry:
    """Return the geometry of all views of all sets."""
    parts = [views.geometry(shape, None) for views, _ in sets]
    images, matrices, spans = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("images", "matrices", "spans")
    )
    return parts[0]._replace(images=images, matrices=matrices, spans=spans)


def _incidence(
    numbers: NDArray[np.int64], geometry: kernels.CanvasGeometry, shape: tuple[int, int], count: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return the solid angle of each pixel in each mask, and which pixels each view sees.

    Args:
        numbers: ``(n, h, w)`` numbers of the masks, from 1; 0 for none.
        geometry: Geometry of the views and a canvas.
        shape: ``(H, W)`` of the canvas.
        count: Number of masks.

    Returns:
        ``(masks, H W)`` steradians, and ``(n, H W)`` ones.
    """
    (height, width), found, pixels = numbers.shape[1:], list[Any](), list[Any]()
    for matrix, spans, of_view in zip(geometry.matrices, geometry.spans, numbers, strict=True):
        start, length = spans.T
        row = np.repeat(np.arange(shape[0]), length)
        before = np.repeat(np.cumsum(length) - length - start, length)
        column = (np.arange(len(row)) - before) % shape[1]
        across, up = geometry.rows[row].T
        east, north = across * geometry.columns[:, column]
        u, v, w = matrix @ np.stack([east, north, up])
        x, y = np.floor(u / w + 0.5).astype(np.int64), np.floor(v / w + 0.5).astype(np.int64)
        inside = (w > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixels.append((row * shape[1] + column)[inside])
        found.append(of_view[y[inside], x[inside]])
    view = np.repeat(np.arange(len(pixels)), [len(of_view) for of_view in pixels])
    pixel, number = np.concatenate(pixels), np.concatenate(found)
    seen = sparse.csr_array((np.ones(len(pixel)), (view, pixel)), (len(numbers), math.prod(shape)))
    pixel, number = pixel[number > 0], number[number > 0] - 1
    weights = _pixel_weights(shape).ravel()[pixel]
    return sparse.csr_array((weights, (number, pixel)), (count, math.prod(shape))), seen


def _groups(
    masks: sparse.csr_array,
    seen: sparse.csr_array,
    view: NDArray[np.int64],
    classes: NDArray[np.int64],
    least: float,
) -> NDArray[np.int64]:
    """Return the number of the object of each mask, see `join_objects`.

    Args:
        masks: See `_incidence`.
        seen: See `_incidence`.
        view: ``(masks,)`` view of each mask.
        classes: ``(masks,)`` class of each mask.
        least: Smallest overlap.
    """
    within = (masks @ seen.T).toarray()
    both = sparse.coo_array(masks @ (masks > 0).T.astype(float))
    a, b = both.row, both.col
    overlap = both.data / (within[a, view[b]] + within[b, view[a]] - both.data)
    is_pair = (a < b) & (view[a] != view[b]) & (classes[a] == classes[b]) & (overlap >= least)
    order = np.argsort(-overlap[is_pair], kind="stable")
    group = np.arange(len(view))
    views = [{number} for number in view.tolist()]
    for first, second in zip(a[is_pair][order], b[is_pair][order], strict=True):
        one, other = group[first], group[second]
        if one != other and views[one].isdisjoint(views[other]):
            group[group == other] = one
            views[one] |= views[other]
    found: NDArray[np.int64] = np.unique(group, return_inverse=True)[1]
    return found


def _kept(objects: Objects, covered: NDArray[np.float64]) -> Objects:
    """Leave out small objects, and those that others have covered.

    Args:
        objects: Objects.
        covered: Solid angle of the union of the masks of each object.
    """
    count = len(objects.scores)
    won = solid_angles(objects.numbers, count)
    is_kept = (won >= _LEAST_SR) & (won >= _LEAST_SHARE * covered)
    table = np.append(0, np.cumsum(is_kept) * is_kept).astype(np.int32)
    return Objects(table[objects.numbers], objects.classes[is_kept], objects.scores[is_kept])


def solid_angles(numbers: Numbers, count: int) -> NDArray[np.float64]:
    """Return the solid angle ``(n,)`` of each object, or of a photo its share times 4π."""
    weights = _pixel_weights(numbers.shape)
    found: Any = np.bincount(numbers.ravel(), weights.ravel(), count + 1)
    return np.asarray(found[1:], np.float64)


def _pixel_weights(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the solid angle of the pixels of a panorama; of a photo, equal parts of 4π."""
    height, width = shape
    if width != 2 * height:
        return np.full((height, width), 4 * math.pi / (height * width))
    return np.broadcast_to(equirect_solid_angles((height, width))[:, None], (height, width))


def described(
    objects: Objects, class_names: Sequence[str], distance: NDArray[np.floating] | None = None
) -> list[dict[str, Any]]:
    """Return a table of objects, the largest solid angle first.

    A spherical box has a center and a field of view: the object's ranges of longitude and latitude
    in a frame in which the center of the box is straight ahead.

    Args:
        objects: Objects of a panorama.
        class_names: Names of the classes.
        distance: ``(H, W)`` distances from the center, NaN where unknown.

    Returns:
        For each object its ``number`` in the map, ``class``, ``score``, ``longitude_deg``,
        ``latitude_deg``, ``width_deg`` and ``height_deg`` of its box, ``solid_angle_sr``, and
        ``distance``, the median by pixels.
    """
    shape = objects.numbers.shape
    directions = equirect_directions((shape[0], shape[1])).reshape(-1, 3)
    pixels = np.flatnonzero(objects.numbers)
    pixels = pixels[np.argsort(objects.numbers.ravel()[pixels], kind="stable")]
    angles = solid_angles(objects.numbers, len(objects.scores))
    ends = np.cumsum(np.bincount(objects.numbers.ravel(), minlength=len(angles) + 1)[1:])
    entries = []
    for k, part in enumerate(np.split(pixels, ends[:-1])[: len(angles)]):
        center, extent = _box(directions[part])
        extent = extent + math.pi / shape[0]  # between outer edges of pixels
        entry = {
            "number": k + 1,
            "class": class_names[objects.classes[k]],
            "score": round(float(objects.scores[k]), 4),
            **dict(zip(_BOX, np.degrees([*center, *extent]).round(2).tolist(), strict=True)),
            "solid_angle_sr": float(f"{angles[k]:.4g}"),
        }
        if distance is not None:
            known = distance.ravel()[part]
            entry["distance"] = round(float(np.nanmedian(known)), 3) if known.any() else None
        entries.append(entry)
    return sorted(entries, key=lambda entry: -entry["solid_angle_sr"])


def _box(directions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return center (longitude, latitude) and extent of the spherical box of directions (n, 3)."""
    center = directions.mean(axis=0)
    for _ in range(_STEPS):
        longitude, latitude = xyz_to_lonlat(center)
        right, up = (longitude + np.pi / 2, 0.0), (longitude, latitude + np.pi / 2)
        frame = lonlat_to_xyz([(longitude, latitude), right, up])
        local = xyz_to_lonlat(directions @ frame.T)
        low, high = local.min(axis=0), local.max(axis=0)
        center = frame.T @ lonlat_to_xyz((low + high) / 2)
    return xyz_to_lonlat(center), high - low
