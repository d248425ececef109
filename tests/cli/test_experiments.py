"""Every experiment, found in its folder: at full size without numbers, then one real small step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import lightning
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.compose import config_folder
from tangent_train.cli.run import build

if TYPE_CHECKING:
    from pathlib import Path

FOLDER = config_folder() / "experiment"
EXPERIMENTS = sorted(
    path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml")
)
AREAS = ("1", "2", "3", "4", "5a", "5b", "6")
ROWS = 32


class OneStep(lightning.Callback):
    """Ends the training after its first step, however long it was planned."""

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        trainer.should_stop = True


@pytest.fixture(scope="module")
def rooms_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the first experiment on made rooms makes them, for all."""
    return tmp_path_factory.mktemp("rooms")


def _composed(experiment: str) -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("train", [f"experiment={experiment}"])


def _shrunk(config: DictConfig, stanford_root: Path, rooms_root: Path) -> dict[str, Any]:
    """Settings for images of 32 pixels, few of them, the shallower network and data made here."""
    settings = {
        "level": 5 + config.representation.get("base_level", 0),
        "representation.erp_height": ROWS,
        "data.panoramas_per_step": 2,
        "data.num_workers": 0,
    }
    for name, value in (("faces_per_panorama", 3), ("crop_deg", 180)):
        if config.representation.get(name) is not None:
            settings[f"representation.{name}"] = value
    if "depth" in config.network:
        settings["network.depth"] = 50
    if "rooms" not in config.data:
        return {**settings, "data.root": str(stanford_root)}
    rooms = {f"data.rooms.rooms.area_{area}": 1 for area in AREAS}
    return {**settings, **rooms, "data.rooms.height": ROWS, "data.root": str(rooms_root)}


def _one_step(config: DictConfig, task: Any, data: Any, folder: Path) -> lightning.Trainer:
    trainer: lightning.Trainer = instantiate(
        config.trainer,
        accelerator="cpu",
        default_root_dir=str(folder),
        callbacks=[OneStep()],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        limit_train_batches=1,
        limit_val_batches=0,
        use_distributed_sampler=False,
    )
    trainer.fit(task, datamodule=data)
    return trainer


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_instantiates_and_takes_a_step(
    experiment: str, stanford_root: Path, rooms_root: Path, tmp_path: Path
) -> None:
    config = _composed(experiment)
    assert config.name in (experiment, experiment.removeprefix("rooms/"))
    if "weights" in config.network:
        config.network.weights = None  # nothing from the internet
    with torch.device("meta"):  # shapes only: build runs the network on an image of full size
        data, task = build(config)
    assert len(task.class_names) == len(data.class_names) == 14
    names = set(task.state_dict())

    for setting, value in _shrunk(config, stanford_root, rooms_root).items():
        OmegaConf.update(config, setting, value)
    data, task = build(config)
    if config.network.get("depth") is None:
        assert set(task.state_dict()) == names, "the same network, smaller images"
    before = {name: p.detach().clone() for name, p in task.network.named_parameters()}
    trainer = _one_step(config, task, data, tmp_path)
    assert trainer.global_step == 1
    assert trainer.callback_metrics["train/loss"] > 0
    for name, parameter in task.network.named_parameters():
        assert parameter.isfinite().all(), name
    changed = [n for n, p in task.network.named_parameters() if not torch.equal(p, before[n])]
    assert len(changed) > len(before) / 2
