"""Scores of distances that ignore the image, on the test split: a constant, or one of each row.

``python -m studies.constant_depth experiment=rooms/depth`` takes the settings of tangent-train.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from numpy.typing import NDArray

from datamodules.core.depth import STEPS_PER_M
from tangent_train.cli.run import build_data, build_head
from tangent_train.config.settings import config_name, validate
from tangent_train.files import config_folder
from tangent_train.results.evaluation import evaluation_result, summary_lines


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
    name = config_name("train", ())
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose(name, parser.parse_args().settings)
    settings = validate("train", config)
    data = build_data(settings)
    data.make_files()
    train, test = data.dataset("train"), data.dataset("test")
    targets = [train.read(index).labels.astype(np.int32) for index in range(len(train))]
    head = build_head(settings, data)
    for name, meters in constants(np.stack(targets)).items():
        metric = head.build_metric()
        for index in range(len(test)):
            truth = head.truth(test[index].labels)
            guess = torch.from_numpy(meters).float().expand(truth.shape)
            metric.update(head.comparable(guess, truth), truth)
        result = evaluation_result(head, metric.compute(), data.noun, len(test))
        result = replace(result, protocol={**data.facts, **head.facts})
        print(f"{name}, {np.median(meters):.2f} m:", *summary_lines(result), sep="\n  ")


if __name__ == "__main__":
    main()
