"""Every experiment, found in its folder: at full size without numbers, then one real small step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.build import build
from tangent_train.cli.compose import config_folder
from tangent_train.cli.transfer_stages import plan
from tangent_train.registry import make
from tests.datamodules.modelnet40.shapes_format import write_tree
from tests.running import composed

# network.frozen_statistics=true
pytestmark = pytest.mark.filterwarnings("ignore:Found .* in eval mode:UserWarning")

FOLDER = config_folder() / "experiment"
FOUND = sorted(
    path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml")
)
TRANSFERS = [name for name in FOUND if Path(name).name.startswith("transfer")]
EXPERIMENTS = [name for name in FOUND if name not in (*TRANSFERS, "zero_shot")]
AREAS = ("1", "2", "3", "4", "5a", "5b", "6")
ROWS = 32


class OneStep(lightning.Callback):
    """Ends the training after its first step, however long it was planned."""

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        trainer.should_stop = True


@pytest.fixture(scope="module")
def roots(stanford_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Data of every kind, or where the first experiment generates them."""
    folder = tmp_path_factory.mktemp("data")
    return {
        "Stanford2D3DS": stanford_root,
        "SynthRooms": folder / "rooms",
        "ModelNet40": write_tree(folder / "meshes"),
        "SynthShapes": folder / "shapes",
    }


def _shrunk(config: DictConfig, roots: dict[str, Path]) -> dict[str, Any]:
    """Settings for images of 32 pixels, few of them, the shallower network and small data."""
    kind = config.data._target_.rpartition(".")[2]
    optional = {
        "representation.faces_per_panorama": 3,
        "representation.crop_deg": 180,
        "network.depth": 50,
        "data.panoramas_per_step": 2,
        "data.rooms.height": ROWS,
        "data.shapes.train": 3,
        "data.shapes.test": 2,
    }
    settings: dict[str, Any] = {
        name: value
        for name, value in optional.items()
        if OmegaConf.select(config, name) is not None
    }
    settings |= {"data.root": str(roots[kind]), "data.num_workers": 0}
    if kind in ("ModelNet40", "SynthShapes"):
        return {**settings, "level": 4}
    if kind == "SynthRooms":
        settings |= {f"data.rooms.rooms.area_{area}": 1 for area in AREAS}
    level = 5 + config.representation.get("base_level", 0)
    return {**settings, "level": level, "representation.erp_height": ROWS}


def _plain(config: DictConfig) -> dict[str, Any]:
    settings: Any = OmegaConf.to_container(config, resolve=True)
    return settings


def _one_step(config: DictConfig, task: Any, data: Any, folder: Path) -> lightning.Trainer:
    trainer: lightning.Trainer = make(
        _plain(config.trainer),
        "trainer",
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


def _takes_a_step(config: DictConfig, folder: Path) -> set[str]:
    """Build the parts of a run and train one step; the names of all tensors."""
    data, task = build(_plain(config))
    before = {name: p.detach().clone() for name, p in task.network.named_parameters()}
    trainer = _one_step(config, task, data, folder)
    assert trainer.global_step == 1
    assert trainer.callback_metrics["train/loss"] > 0
    for name, parameter in task.network.named_parameters():
        assert parameter.isfinite().all(), name
    changed = [n for n, p in task.network.named_parameters() if not torch.equal(p, before[n])]
    assert len(changed) > len(before) / 2
    return set(task.state_dict())


def _builds_at_full_size(config: DictConfig) -> set[str]:
    """Build it without numbers; the names of all tensors."""
    if "weights" in config.network:
        config.network.weights = None  # nothing from the internet
    with torch.device("meta"):  # shapes only: build runs the network on an image of full size
        data, task = build(_plain(config))
    assert task.class_names == data.class_names
    return set(task.state_dict())


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_instantiates_and_takes_a_step(
    experiment: str, roots: dict[str, Path], tmp_path: Path
) -> None:
    config = composed("train", f"experiment={experiment}")
    assert config.name in (experiment, experiment.removeprefix("rooms/"))
    names = _builds_at_full_size(config)
    for setting, value in _shrunk(config, roots).items():
        OmegaConf.update(config, setting, value)
    stepped = _takes_a_step(config, tmp_path)
    if config.network.get("depth") is None:
        assert stepped == names, "the same network, smaller images"


@pytest.mark.parametrize("experiment", TRANSFERS)
def test_both_kinds_of_images_of_a_transfer_get_one_network(
    experiment: str, tmp_path: Path
) -> None:
    config = composed("transfer", f"experiment={experiment}")
    assert config.name == experiment
    stages = plan(config, tmp_path, {})
    first = [stage for stage in stages if stage.fold == stages[0].fold]
    assert first[-1].name.startswith("S-FT-")
    photos = next(stage for stage in first if stage.name == "P")
    names = [_builds_at_full_size(OmegaConf.create(s.config)) for s in (photos, first[-1])]
    assert names[0] == names[1]
