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
from scipy.ndimage import find_objects

from datamodules.core.depth import STEPS_PER_M
from models.segments import Segments
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    equirect_to_lonlat,
    lonlat_to_xyz,
    pixel_solid_angles,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import Floats
from tangent_train.rendering import kernels
from tangent_train.rendering.representations.perspective import PhotoCrops
from tangent_train.rendering.representations.views import PinholeViews, Views
from tangent_train.rendering.resampling import resize

_ROWS = 512
"""Rows of the canvas on which masks are compared, at most."""

_LEAST_SHARE = 0.5
"""Part of its masks that an object must win, else it is left out."""

_LEAST_SR = 1e-5
"""Solid angle of the smallest object, in steradians: a disc of 0.2°."""

_BOX = "longitude_deg", "latitude_deg", "width_deg", "height_deg"
OBJECT_COLUMNS = ("number", "class", "score", *_BOX, "solid_angle_sr", "distance_m")
"""Names in the table of objects, see `described`."""

_STEPS = 3
"""Steps in which the center of a spherical box moves from the mean direction to its middle."""


class Objects(NamedTuple):
    """Objects of a panorama or photo.

    Attributes:
        numbers: ``(H, W)`` int32 number of the object at each pixel, 0 for none; 1 is the largest.
        classes: ``(n,)`` index of the class of each object.
        scores: ``(n,)`` confidence of each object, 0 to 1: the mean of its masks by solid angle.
        solid_angles: ``(n,)`` steradians.
    """

    numbers: NDArray[np.int32]
    classes: NDArray[np.int64]
    scores: NDArray[np.float64]
    solid_angles: NDArray[np.float64]


def join_objects(
    sets: Sequence[tuple[Views, Sequence[Segments]]],
    shape: tuple[int, int],
    camera_matrix: Floats | None = None,
    valid: NDArray[np.bool_] | None = None,
    is_thing: NDArray[np.bool_] | None = None,
    least_overlap: float = 0.3,
) -> Objects:
    """Put together the objects of a panorama or photo.

    Args:
        sets: Sets of views, pinhole images or crops of one size, and the objects of each view.
        shape: ``(H, W)`` of the panorama or photo.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centers; None for a panorama.
        valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
        is_thing: ``(K,)`` True for classes that have objects, to leave out those of others and of
            the class −1; None to take all.
        least_overlap: Intersection over union, at the directions that two views see, from which
            masks join; measured in docs/explanation/objects.md.

    Raises:
        SettingError: The views are not pinhole images.
    """
    segments = [of_view for _, of_views in sets for of_view in of_views]
    first = np.cumsum([0, *(len(of_view.scores) for of_view in segments)])
    classes, scores = (
        np.concatenate([getattr(of_view, name).cpu().numpy() for of_view in segments])
        for name in ("classes", "scores")
    )
    numbers = np.stack([of_view.numbers.cpu().numpy() for of_view in segments])
    numbers = np.where(numbers > 0, numbers + first[:-1, None, None], 0)
    view = np.repeat(np.arange(len(segments)), np.diff(first))
    if is_thing is not None:
        chosen = np.append(is_thing, False)[classes]
        numbers = np.append(0, chosen.cumsum() * chosen)[numbers]
        classes, scores, view = classes[chosen], scores[chosen], view[chosen]
    rows = min(shape[0], _ROWS)
    small = shape if camera_matrix is not None else (rows, 2 * rows)
    valid = np.ones(shape, np.bool_) if valid is None else valid
    weights = (pixel_solid_angles(small, camera_matrix) * resize(valid, small, "nearest")).ravel()
    masks, seen = _incidence(numbers, _geometry(sets, small), weights, len(classes))
    group = _groups(masks, seen, view, classes, least_overlap)
    area = masks.sum(axis=1) + 1e-12  # masks may lie between the pixels of the canvas
    of_group = np.bincount(group, area * scores) / np.bincount(group, area)
    count = len(of_group)
    class_of = np.zeros(count, np.int64)
    class_of[group] = classes
    winners = np.zeros(shape, np.int32)
    table = np.append(0, group + 1).astype(np.int32)[numbers]
    votes = np.append(1, of_group).astype(np.float32)
    kernels.over_rows(kernels.vote, *shape, table, _geometry(sets, shape), votes, winners)
    of_masks = np.ones(len(group)), (group, np.arange(len(group)))
    in_groups = sparse.csr_array(of_masks, (count, len(group)))
    covered = (in_groups @ masks).astype(bool) @ weights
    winners *= valid
    angles = pixel_solid_angles(shape, camera_matrix)
    won: Any = np.bincount(winners.ravel(), angles.ravel(), count + 1)[1:]
    kept = np.flatnonzero((won >= _LEAST_SR) & (won >= _LEAST_SHARE * covered))
    kept = kept[np.argsort(-won[kept], kind="stable")]
    table = np.zeros(count + 1, np.int32)
    table[kept + 1] = np.arange(1, len(kept) + 1)
    return Objects(table[winners], class_of[kept], of_group[kept], won[kept])


def _geometry(sets: Sequence[tuple[Views, Any]], shape: tuple[int, int]) -> kernels.CanvasGeometry:
    """Return the geometry of all views of all sets."""
    for views, _ in sets:
        if not isinstance(views, PinholeViews | PhotoCrops):
            expected = "pinhole images: horizontal views, tangent images or a cube map"
            raise SettingError("views", found=type(views).__name__, expected=expected)
    parts = [views.geometry(shape, None) for views, _ in sets]
    images, matrices, spans = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("images", "matrices", "spans")
    )
    return parts[0]._replace(images=images, matrices=matrices, spans=spans)


def _incidence(
    numbers: NDArray[np.int64], geometry: kernels.CanvasGeometry, weights: Floats, count: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return the solid angle of each pixel in each mask, and which pixels each view sees.

    Args:
        numbers: ``(n, h, w)`` numbers of the masks, from 1; 0 for none.
        geometry: Geometry of the views and a canvas ``(H, W)``.
        weights: ``(H W,)`` solid angle of the pixels of the canvas; 0 for invalid ones.
        count: Number of masks.

    Returns:
        ``(masks, H W)`` steradians, and ``(n, H W)`` ones.
    """
    canvas = len(geometry.rows), geometry.columns.shape[1]
    (height, width), found, pixels = numbers.shape[1:], list[Any](), list[Any]()
    for matrix, spans, of_view in zip(geometry.matrices, geometry.spans, numbers, strict=True):
        start, length = spans.T
        row = np.repeat(np.arange(canvas[0]), length)
        before = np.repeat(np.cumsum(length) - length - start, length)
        column = (np.arange(len(row)) - before) % canvas[1]
        across, up = geometry.rows[row].T
        east, north = across * geometry.columns[:, column]
        u, v, w = matrix @ np.stack([east, north, up])
        x, y = np.floor(u / w + 0.5).astype(np.int64), np.floor(v / w + 0.5).astype(np.int64)
        pixel = row * canvas[1] + column
        inside = (w > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height) & (weights[pixel] > 0)
        pixels.append(pixel[inside])
        found.append(of_view[y[inside], x[inside]])
    view = np.repeat(np.arange(len(pixels)), [len(of_view) for of_view in pixels])
    pixel, number = np.concatenate(pixels), np.concatenate(found)
    seen = sparse.csr_array((np.ones(len(pixel)), (view, pixel)), (len(numbers), len(weights)))
    pixel, number = pixel[number > 0], number[number > 0] - 1
    return sparse.csr_array((weights[pixel], (number, pixel)), (count, len(weights))), seen


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


def described(objects: Objects, class_names: Sequence[str], image: Any) -> list[dict[str, Any]]:
    """Return a table of objects in the order of their numbers.

    A spherical box has a center and a field of view: the object's ranges of longitude and latitude
    in a frame in which the center of the box is straight ahead.

    Args:
        objects: Objects of a panorama or photo.
        class_names: Names of the classes.
        image: `InputImage`, with depth for distances.

    Returns:
        For each object its ``number`` in the map, ``class``, ``score``; ``longitude_deg``,
        ``latitude_deg``, ``width_deg`` and ``height_deg`` of its box, in a photo relative to the
        optical axis; ``solid_angle_sr``; and ``distance_m``, the median of its known distances by
        solid angle, None without any.
    """
    numbers, entries = objects.numbers, []
    weights = pixel_solid_angles(numbers.shape, image.camera_matrix)
    for k, part in enumerate(find_objects(numbers)):
        place = tuple(np.argwhere(numbers[part] == k + 1).T + [[side.start] for side in part])
        directions = _directions(place, numbers.shape, image.camera_matrix)
        center, extent = _box(directions)
        # Between outer edges of pixels.
        extent = np.minimum(extent + math.sqrt(weights.max()), (2 * math.pi, math.pi))
        distance = None
        if image.depth is not None:
            ahead = 1 if image.camera_matrix is None else directions[:, 0]
            distance = _median(image.depth[place] / STEPS_PER_M / ahead, weights[place])
        entries.append(
            {
                "number": k + 1,
                "class": class_names[objects.classes[k]],
                "score": round(float(objects.scores[k]), 4),
                **dict(zip(_BOX, np.degrees([*center, *extent]).round(2).tolist(), strict=True)),
                "solid_angle_sr": float(f"{objects.solid_angles[k]:.4g}"),
                "distance_m": distance,
            }
        )
    return entries


def _median(values: Floats, weights: Floats) -> float | None:
    """Return the weighted median of the values above 0; None without any."""
    known = values > 0
    if not known.any():
        return None
    how: Any = {"weights": weights[known], "method": "inverted_cdf"}
    return float(f"{np.quantile(values[known], 0.5, **how):.4g}")


def _directions(place: Any, shape: tuple[int, ...], camera_matrix: Floats | None) -> Floats:
    """Return the directions ``(n, 3)`` of rows and columns; x is straight ahead in a photo."""
    row, column = place
    if camera_matrix is None:
        size = shape[0], shape[1]
        return lonlat_to_xyz(equirect_to_lonlat(np.stack([column, row], axis=-1), size))
    x, y, z = np.linalg.inv(camera_matrix) @ np.stack([column, row, np.ones(len(row))])
    return np.stack([z, x, -y], axis=-1) / np.sqrt(x**2 + y**2 + z**2)[:, None]


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
