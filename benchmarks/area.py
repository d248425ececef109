"""Time predictions of a partial panorama, compared with the whole one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch

from benchmarks.measuring import Alternative, Goal, Table, measure
from datamodules.core.inputs import RGB_NORMALIZATION
from models import UNet
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.io.gpano import PanoramaArea

WHOLE, PART = "whole panorama", "35° above and below the horizon"


def area(quick: bool) -> Iterator[Table]:
    """Yield a table of the time of a small UNet for tangent images."""
    level = 5 if quick else 8
    torch.manual_seed(0)
    network = UNet(3, 13, (16, 24, 32, 48)).eval()
    rows = 2 ** (level + 1)
    rgb = np.random.default_rng(0).integers(0, 256, (rows, 2 * rows, 3), np.uint8)
    canvas = PanoramaArea.on_canvas((-180, 180, -35.15625, 35.15625), rows)
    images = {
        WHOLE: InputImage(rgb),
        PART: InputImage(canvas.place(canvas.cut(rgb)), area=canvas),
    }
    trained = LoadedNetwork(
        module=network,
        class_names=("unknown", *map(str, range(13))),
        inputs=("rgb",),
        normalization=RGB_NORMALIZATION,
        level=level,
        representation={
            "_target_": "tangent_train.rendering.TangentRepresentation",
            "base_level": 0,
            "level": level,
        },
        image_size=(2**level, 2**level),
    )
    predictor = Predictor(trained, head_of(trained), ViewSelector(trained))
    alternatives = [
        Alternative(of, partial(predictor.predict, image), of == PART)
        for of, image in images.items()
    ]
    table = Table("area: tangent", measure(alternatives, 2 if quick else 5))
    table.goals = [Goal("time of the part", table.ratio(PART), 0.6)]
    yield table
