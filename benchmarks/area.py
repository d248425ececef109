"""Time predictions of a partial panorama, compared with the whole one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from benchmarks.measuring import Alternative, Goal, Table, measure, tangent_network
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.io.gpano import PanoramaArea

WHOLE, PART = "whole panorama", "35° above and below the horizon"


def area(quick: bool) -> Iterator[Table]:
    """Yield a table of the time of a small UNet for tangent images."""
    level = 5 if quick else 8
    rows = 2 ** (level + 1)
    rgb = np.random.default_rng(0).integers(0, 256, (rows, 2 * rows, 3), np.uint8)
    canvas = PanoramaArea.on_canvas((-180, 180, -35.15625, 35.15625), rows)
    images = {
        WHOLE: InputImage(rgb),
        PART: InputImage(canvas.place(canvas.cut(rgb)), area=canvas),
    }
    trained = tangent_network(level, (16, 24, 32, 48))
    predictor = Predictor(trained, head_of(trained), ViewSelector(trained))
    alternatives = [
        Alternative(of, partial(predictor.predict, image), of == PART)
        for of, image in images.items()
    ]
    table = Table("area: tangent", measure(alternatives, 2 if quick else 5))
    table.goals = [Goal("time of the part", table.ratio(PART), 0.6)]
    yield table
