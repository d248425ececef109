"""Scores of distances that ignore the image, on the test split: a constant, or one of each row.

``python -m studies.constant_depth experiment=rooms/depth`` takes the settings of tangent-train.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from numpy.typing import NDArray
from omegaconf import OmegaConf
from torch import nn

from datamodules.core.images import STEPS_PER_M
from tangent_train.cli.run import build_data
from tangent_train.config.build import build_from_config
from tangent_train.files import config_folder
from tangent_train.results.evaluation import summary_lines


def constants(steps: NDArray[np.int32]) -> dict[str, NDArray[np.float64]]:
    """Return distances in meters ``(H or 1, 1)`` by name, from those of training ``(n, H, W)``."""
    meters = np.where(steps > 0, steps / STEPS_PER_M, np.nan)
    known = np.sort(meters[steps > 0])
    share = np.cumsum(1 / known)  # the absolute relative error weights an error by 1 / distance
    constant = known[np.searchsorted(share, share[-1] / 2)]
    rows = np.nanmedian(meters, axis=(0, 2))[:, None]
    found = {"median": np.median(known), "smallest AbsRel": constant, "median of the row": rows}
    return {name: np.atleast_2d(value) for name, value in found.items()}


def main() -> None:
    """Print the scores of each constant."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("settings", nargs="+", metavar="<setting>=<value>")
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("train", parser.parse_args().settings)
    settings: Any = OmegaConf.to_container(config, resolve=True)
    data = build_data(settings)
    data.make_files()
    train, test, view = data.dataset("train"), data.dataset("test"), data.representation
    targets = [train.read(index).target(view).astype(np.int32) for index in range(len(train))]
    empty: dict[str, Any] = {"network": nn.Identity(), "class_names": (), "optimizer": None}
    for name, meters in constants(np.stack(targets)).items():
        task = build_from_config(settings["task"], "task", representation=view, **empty)
        for index in range(len(test)):
            truth = task.meters(torch.from_numpy(test.read(index).target(view).astype(np.int32)))
            guess = torch.from_numpy(meters).float().expand(truth.shape)
            task.metric.update(task.protocol.aligned(guess, truth), truth)
        task.evaluated = len(test)
        record = task.evaluation_result(task.metric.compute(), data.noun)
        record = replace(record, protocol={**data.facts, **task.facts})
        print(f"{name}, {np.median(meters):.2f} m:", *summary_lines(record), sep="\n  ")


if __name__ == "__main__":
    main()
