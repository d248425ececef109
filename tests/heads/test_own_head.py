"""A third kind of output, a head and its metric, is evaluated and predicted."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tangent_train.rendering import TangentRepresentation
from tangent_train.results.evaluation import evaluation_result
from tangent_train.tasks import PixelTask
from tests.heads.toy_share import ShareHead
from tests.inference.trained import TANGENT, sphere, trained_network
from tests.tasks.shapes import quiet_trainer
from tests.tasks.test_segmentation import NAMES, Data


@pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")
def test_a_head_and_its_metric_are_enough() -> None:
    torch.manual_seed(0)
    head, representation = ShareHead(NAMES, "b"), TangentRepresentation(base_level=0, level=4)
    task = PixelTask(nn.Conv2d(2, 1, 1), representation, head, partial(torch.optim.SGD, lr=5))
    (scores,) = quiet_trainer().test(task, datamodule=Data(), verbose=False)
    result = evaluation_result(head, task.result, "panoramas", task.evaluated)
    assert (result.main, result.scores["mae"]) == ("mae", scores["test/mae"])

    loaded: Any = trained_network(TANGENT)
    loaded.__dict__["network"] = nn.Conv2d(3, 1, 1)
    mosaic = Predictor(loaded, head, ViewSelector(loaded)).predict(InputImage(sphere(32)))
    with torch.no_grad():
        weight = loaded.network.weight.flatten().numpy()
    found = mosaic.pixels().numpy()
    colors = loaded.normalization.mean, loaded.normalization.std
    values = (sphere(32) / 255 - colors[0]) / colors[1] @ weight + loaded.network.bias.item()
    assert np.abs(found - values).mean() < 0.05
