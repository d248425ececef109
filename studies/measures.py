"""Measures of panoramas on predictions with known scores (docs/explanation/measures.md).

``python -m studies.measures`` prints the table and draws the zones of a synthetic room.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from datamodules.synthrooms.datamodule import RoomSettings, SynthRooms, generate_rooms
from studies.output import Row, save
from tangent_train.geometry import equirect_shape
from tangent_train.heads import ClassesHead, DistanceHead
from tangent_train.io.palette import class_colors
from tangent_train.metrics.sphere import near_boundary
from tangent_train.rendering import EquirectRepresentation
from tangent_train.results.chart import COLORS

MEASURES = ("miou_solid_angle", "boundary_miou", "pole_gap", "seam_gap", "seam_step")
CAP_DEG, OFF_DEG, STRIP_DEG = 30, 0.5, 9


def closed_forms(level: int = 9) -> list[Row]:
    """Return the scores of predictions whose scores are known, in percent.

    In the truth, class 1 is within 90° of the middle column, class 2 elsewhere; in the last one of
    classes, class 1 is north. All true distances are 1 m.

    Args:
        level: Level of the panorama.
    """
    height, width = equirect_shape(level)
    rows, columns = np.indices((height, width))
    latitudes_deg = 90 - (rows + 0.5) * 180 / height
    longitudes_deg = (columns + 0.5) * 360 / width - 180
    middle, north, shifted = (
        np.where(is_first, 1, 2)
        for is_first in (abs(longitudes_deg) < 90, latitudes_deg > 0, latitudes_deg > OFF_DEG)
    )
    in_caps, in_strip = abs(latitudes_deg) > 90 - CAP_DEG, longitudes_deg < STRIP_DEG - 180
    found: list[Row] = []
    for name, prediction, truth in (
        ("the ground truth", middle, middle),
        ("class 1 everywhere", np.ones_like(middle), middle),
        ("shifted by half the width", 3 - middle, middle),
        (f"class 1 within {CAP_DEG}° of the poles", np.where(in_caps, 1, middle), middle),
        (f"class 1 in {STRIP_DEG}° east of the seam", np.where(in_strip, 1, middle), middle),
        (f"a boundary off by {OFF_DEG}°", shifted, north),
    ):
        classes = ClassesHead(("unknown", "1", "2"))
        found.append({"prediction": name, **_scores(classes, prediction, truth)})
    growing = np.exp2((columns + 0.5) / width)
    head = DistanceHead(depth_kind="metric_distance")
    step = _scores(head, growing, np.ones_like(growing))["seam_step"]
    last = {"prediction": "distances that grow from 1 m to 2 m", **dict.fromkeys(MEASURES, "")}
    return [*found, {**last, "seam_step": step}]


def _scores(head: Any, prediction: NDArray[Any], truth: NDArray[Any]) -> dict[str, Any]:
    metric = head.build_metric()
    metric.update(torch.from_numpy(prediction), torch.from_numpy(truth))
    means = head.scores(metric.compute()).means
    return {name: 100 * float(means[name]) for name in MEASURES if name in means}


def picture(height: int = 512) -> Figure:
    """Return a synthetic room with the zones of the gaps, and its labels near boundaries."""
    settings = RoomSettings(seed=3, rooms={"1": 1, "5a": 1, "5b": 0}, height=height, supersample=1)
    views = EquirectRepresentation(level=0, erp_height=height)
    with tempfile.TemporaryDirectory() as folder:
        generate_rooms(Path(folder), settings, workers=1)
        data = SynthRooms(Path(folder), views, rooms=settings)
        image = data.dataset("train").read(0)
    labels: Any = image.labels
    colors = class_colors(data.class_names)[labels]
    figure = Figure((13, 3.6), layout="constrained")
    zones, boundaries = figure.subplots(1, 2)
    extent = (-180, 180, -90, 90)
    zones.imshow(image.rgb, extent=extent)
    for color, latitudes in (
        (COLORS[1], (60, 90)),
        (COLORS[1], (-90, -60)),
        (COLORS[0], (-30, 30)),
    ):
        zones.axhspan(*latitudes, color=color, alpha=0.35, lw=0)
    for longitudes in ((-180, -162), (162, 180)):
        zones.axvspan(*longitudes, fill=False, hatch="////", edgecolor="white", lw=0)
    zones.set_title("pole gap: orange minus blue; seam gap: hatched minus the rest")
    boundaries.imshow(
        np.where(near_boundary(labels)[..., None], colors, colors // 4 + 190), extent=extent
    )
    boundaries.set_title("boundary mIoU: the pixels in full color")
    for one in (zones, boundaries):
        one.set(xticks=range(-180, 181, 90), yticks=range(-90, 91, 30))
    return figure


if __name__ == "__main__":
    save("measures", closed_forms(), picture(), digits=4)
