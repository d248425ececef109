"""Scores of a constant depth, the median of the training distances, on the test split.

``python -m studies.constant_depth experiment=rooms/depth`` takes the settings of tangent-train.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import nn

from tangent_train.cli.run import build_data
from tangent_train.files import config_folder
from tangent_train.registry import build_from_config
from tangent_train.results.evaluation import headline


def main() -> None:
    """Print the median and the scores."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("train", sys.argv[1:])
    settings: Any = OmegaConf.to_container(config, resolve=True)
    data = build_data(settings)
    data.make_files()
    train, test = data.source("train"), data.source("test")
    steps = np.concatenate([x[x > 0] for x in map(train.labels, range(len(train)))])
    network, view = nn.Identity(), data.representation
    task = build_from_config(
        settings["task"],
        "task",
        network=network,
        representation=view,
        class_names=(),
        optimizer=None,
    )
    median = float(np.median(steps)) / 512
    for index in range(len(test)):
        truth = task.meters(torch.from_numpy(test.read(index).target(view).astype(np.int32)))
        task.metric.update(task.protocol.aligned(torch.full_like(truth, median), truth), truth)
    task.evaluated = len(test)
    record = task.record(task.metric.compute(), data.noun)
    print(f"Median of the training distances: {median:.2f} m. {headline(record)}")


if __name__ == "__main__":
    main()
