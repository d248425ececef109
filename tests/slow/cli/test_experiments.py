"""Every experiment, found in its folder: all its parts at full size, without numbers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.run import build
from tangent_train.cli.transfer import Stage, stage_settings
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import SETTINGS, validate
from tests.config.test_settings import EXPERIMENTS
from tests.running import command_of, composed

TRANSFERS = [name for name in EXPERIMENTS if command_of(name) == "transfer" and name != "zero_shot"]


def _builds_at_full_size(config: DictConfig) -> set[str]:
    """Build all of a run without numbers; the names of all tensors."""
    if "weights" in config.network:
        config.network.weights = None  # nothing from the internet
    known = [name for name in SETTINGS["check"].model_fields if name in config]
    settings = validate("check", {name: config[name] for name in known})
    with torch.device("meta"):  # shapes only: build runs the network on an image of full size
        data, task = build(settings)
    assert task.head.class_names == data.class_names
    trainer = build_from_config(
        settings.trainer, "trainer", logger=False, enable_checkpointing=False
    )
    assert trainer.max_epochs == settings.trainer["max_epochs"]
    length = {"estimated_stepping_batches": 1000, "num_training_batches": 100}
    task.trainer = run = SimpleNamespace(**length, accumulate_grad_batches=1)
    assert task.configure_optimizers()
    assert run
    return set(task.state_dict())


@pytest.mark.parametrize("experiment", sorted({*EXPERIMENTS} - {*TRANSFERS, "zero_shot"}))
def test_every_experiment_composes_and_instantiates(experiment: str) -> None:
    assert _builds_at_full_size(composed("train", f"experiment={experiment}"))


@pytest.mark.parametrize("experiment", TRANSFERS)
def test_both_kinds_of_images_of_a_transfer_get_one_network(experiment: str) -> None:
    config = composed("transfer", f"experiment={experiment}")
    names = []
    for kind in ("P", "S"):
        stage = Stage(kind, "train", {})
        settings = stage_settings(config, Path(), stage)
        names.append(_builds_at_full_size(OmegaConf.create(settings)))
    assert names[0] == names[1]
