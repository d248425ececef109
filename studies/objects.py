"""Objects of views joined into objects of a panorama (docs/explanation/objects.md).

``python -m studies.objects`` scores the joining of masks with known errors in synthetic rooms, for
several smallest overlaps, and draws the picture.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from datamodules.synthrooms.furniture import build_room, draw_room_type
from datamodules.synthrooms.render import RayScene, draw_camera
from models.segments import Segments
from studies.output import Row, save
from tangent_train.config.build import build_from_config
from tangent_train.geometry import equirect_directions
from tangent_train.heads.objects import join_objects
from tangent_train.inference.views import view_settings
from tangent_train.metrics.panoptic import LABEL, panoptic_sums, quality

THINGS = ("board", "bookcase", "chair", "column", "door", "sofa", "table", "window")
OVERLAPS = (0.1, 0.3, 0.5, 0.7, 0.9, 1.1)
"""Smallest overlaps; nothing reaches the last one: each mask is an object."""

ROWS, ROOMS = 512, 12
MISSED, CONFUSED, SHIFTED = 0.1, 0.05, 3
"""Share of masks that a view misses, and takes for another class; pixels that borders move."""

_LEAST_PIXELS = 40

ItemsAt = Callable[[NDArray[np.float64]], NDArray[np.int64]]


def default_views() -> Any:
    """Return the default views of photo networks, of 256 × 256 pixels."""
    section = view_settings("horizontal_wide") | {"level": 8, "dim": 256}
    return build_from_config(section, "representation")


def items_of_room(seed: int) -> tuple[ItemsAt, NDArray[np.int64]]:
    """Return the item at each direction of a camera in a room, and the class of each item.

    The class is an index of `THINGS`, −1 for others.
    """
    rng = np.random.default_rng(seed)
    scene = RayScene(build_room(rng, draw_room_type(rng)))
    location = draw_camera(scene).location
    classes = np.array([THINGS.index(n) if n in THINGS else -1 for n in scene.room.items])

    def items_at(directions: NDArray[np.float64]) -> NDArray[np.int64]:
        rays = np.ascontiguousarray(directions.reshape(-1, 3) * (1, -1, 1), np.float32)
        return scene.item_of_part[scene.cast(location, rays).part].reshape(directions.shape[:-1])

    return items_at, classes


def masks_of_view(
    items: NDArray[np.int64], classes: NDArray[np.int64], rng: np.random.Generator, errors: float
) -> Segments:
    """Return the objects of a view, with errors as of a network.

    Args:
        items: ``(h, w)`` item of each pixel.
        classes: Class of each item.
        rng: Source of randomness.
        errors: Factor of the rates of errors; 0 for a perfect network.
    """
    numbers, found = np.zeros(items.shape, np.int32), []
    for item in np.unique(items[classes[items] >= 0]):
        mask = (items == item).astype(np.uint8)
        if mask.sum() < _LEAST_PIXELS or rng.random() < errors * MISSED:
            continue
        reach = round(errors * SHIFTED * rng.random())
        change = cv2.erode if rng.random() < 0.5 else cv2.dilate
        mask = change(mask, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        is_other = rng.random() < errors * CONFUSED
        found.append(rng.integers(len(THINGS)) if is_other else classes[item])
        numbers[mask > 0] = len(found)
    scores = torch.from_numpy(rng.uniform(0.6, 1, len(found)).astype(np.float32))
    return Segments(torch.from_numpy(numbers), torch.tensor(found, dtype=torch.int64), scores)


def scored_overlaps() -> list[Row]:
    """Return PQ, SQ and RQ over classes by solid angle for each smallest overlap, in percent."""
    representation = default_views()
    shape, rows = (ROWS, 2 * ROWS), []
    sums: dict[tuple[float, float], Any] = {}
    for seed in range(ROOMS):
        items_at, classes = items_of_room(seed)
        items = items_at(equirect_directions(shape))
        truth = np.where(classes[items] >= 0, (classes[items] + 1) * LABEL + items + 1, 0)
        for errors in (0.0, 1.0):
            rng = np.random.default_rng(seed)
            sets = []
            for views in representation.view_sets():
                directions = views.grid.directions(views.chosen)
                seen = [masks_of_view(items_at(d), classes, rng, errors) for d in directions]
                sets.append((views, seen))
            for overlap in OVERLAPS:
                found = join_objects(sets, shape, least_overlap=overlap)
                codes = np.append(0, (found.classes + 1) * LABEL)[found.numbers] + found.numbers
                # Walls are unknown in the truth; what is predicted there must count as wrong.
                known = np.where(truth > 0, truth, (len(THINGS) + 1) * LABEL)
                given = np.where(codes > 0, codes, (len(THINGS) + 1) * LABEL)
                of_room = panoptic_sums(given, known, len(THINGS) + 2)[1, 0, :-1]
                sums[errors, overlap] = sums.get((errors, overlap), 0) + of_room
    for errors in (0.0, 1.0):
        for overlap in OVERLAPS:
            scores = quality(sums[errors, overlap])
            means = {name.upper(): 100 * float(np.nanmean(of)) for name, of in scores.items()}
            masks = "with errors" if errors else "perfect"
            rows.append({"masks": masks, "overlap": overlap if overlap <= 1 else "–", **means})
    return rows


def picture(seed: int = 3) -> Figure:
    """Draw the masks of three views, and the joined objects."""
    items_at, classes = items_of_room(seed)
    rng, sets = np.random.default_rng(seed), []
    for views in default_views().view_sets():
        directions = views.grid.directions(views.chosen)
        sets.append((views, [masks_of_view(items_at(d), classes, rng, 0.0) for d in directions]))
    found, (_, seen) = join_objects(sets, (ROWS, 2 * ROWS)), sets[0]
    colors = np.random.default_rng(1).integers(60, 230, (256, 3), np.uint8)
    colors[0] = 235
    items, count = items_at(equirect_directions((ROWS, 2 * ROWS))), len(found.scores)
    shown = [np.bincount(items[found.numbers == k]).argmax() + 1 for k in range(1, count + 1)]
    first = sets[0][0]
    figure = Figure((9, 5.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=[1, 1.25])
    top, bottom = parts
    for axes, number in zip(top.subplots(1, 3), first.chosen[:3], strict=True):
        (of_view,) = items_at(first.grid.directions([number]))
        axes.imshow(colors[np.where(classes[of_view] >= 0, of_view + 1, 0)])
        axes.set_title(f"view {number + 1}: {len(seen[number].classes)} masks", fontsize=9)
        axes.set_axis_off()
    axes = bottom.subplots()
    axes.imshow(colors[np.array([0, *shown])[found.numbers]])
    counts = [len(of_view.classes) for _, of_views in sets for of_view in of_views]
    title = f"{sum(counts)} masks of {len(counts)} views: {len(found.scores)} objects"
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
    return figure


if __name__ == "__main__":
    save("objects", scored_overlaps(), picture(), digits=3)
