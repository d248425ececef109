"""Every experiment, found in its folder: at full size without numbers, then one real small step."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from datamodules.synthshapes.generate import ShapeSettings, generate_shapes
from tangent_train.cli.build import build
from tangent_train.cli.compose import config_folder
from tangent_train.cli.transfer_stages import Stage, plan
from tangent_train.registry import make
from tests.datamodules.synthia.synthia_format import write_panoramas, write_views

if TYPE_CHECKING:
    from tests.conftest import FabricateStanford

# network.frozen_statistics=true
pytestmark = pytest.mark.filterwarnings("ignore:Found .* in eval mode:UserWarning")

FOLDER = config_folder() / "experiment"
FOUND = sorted(
    path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml")
)
TRANSFERS = [name for name in FOUND if Path(name).name.startswith("transfer")]
SHAPES = [name for name in FOUND if name.startswith("shapes/") or "modelnet" in name]
EXPERIMENTS = [name for name in FOUND if name not in (*TRANSFERS, *SHAPES)]
AREAS = ("1", "2", "3", "4", "5a", "5b", "6")
ROWS = 32


class OneStep(lightning.Callback):
    """Ends the training after its first step, however long it was planned."""

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        trainer.should_stop = True


@pytest.fixture(scope="module")
def rooms_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder where the first experiment generates synthetic rooms, for all."""
    return tmp_path_factory.mktemp("rooms")


@pytest.fixture(scope="module")
def photo_roots(
    tmp_path_factory: pytest.TempPathFactory, fabricate_stanford: FabricateStanford
) -> dict[str, Path]:
    """Data sets with photos and panoramas: where each is, or is to be made."""
    folder = tmp_path_factory.mktemp("photos")
    frames = {"01": 2, "02": 1, "04": 1, "05": 1, "06": 1}
    write_panoramas(write_views(folder / "synthia", frames), frames, ROWS)
    return {
        "Stanford2D3DS": fabricate_stanford(folder / "stanford", height=ROWS, photos=2),
        "OmniSynthia": folder / "synthia",
        "SynthRooms": folder / "rooms",
    }


def _composed(experiment: str, name: str = "train") -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(name, [f"experiment={experiment}"])


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
    """Build what a run is made of and train one step; the names of all tensors."""
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
    assert len(task.class_names) == len(data.class_names) == 14
    return set(task.state_dict())


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_composes_instantiates_and_takes_a_step(
    experiment: str, stanford_root: Path, rooms_root: Path, tmp_path: Path
) -> None:
    config = _composed(experiment)
    assert config.name in (experiment, experiment.removeprefix("rooms/"))
    names = _builds_at_full_size(config)
    for setting, value in _shrunk(config, stanford_root, rooms_root).items():
        OmegaConf.update(config, setting, value)
    stepped = _takes_a_step(config, tmp_path)
    if config.network.get("depth") is None:
        assert stepped == names, "the same network, smaller images"


@pytest.fixture(scope="module")
def shapes_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shapes of every class for training, two for the test."""
    root = tmp_path_factory.mktemp("shapes")
    generate_shapes(root, ShapeSettings(train=3, test=2))
    return root


@pytest.mark.parametrize("experiment", SHAPES)
def test_every_experiment_on_shapes_composes_instantiates_and_takes_a_step(
    experiment: str, shapes_root: Path, tmp_path: Path
) -> None:
    config = _composed(experiment)
    assert config.name == experiment
    with torch.device("meta"):
        data, task = build(_plain(config))
    assert (
        len(task.class_names) == len(data.class_names) == (40 if "modelnet" in experiment else 10)
    )
    small = {"level": 4, "data.root": str(shapes_root), "data.num_workers": 0}
    if "shapes" in config.data:
        small |= {"data.shapes.train": 3, "data.shapes.test": 2}
    for setting, value in small.items():
        OmegaConf.update(config, setting, value)
    stepped = _takes_a_step(config, tmp_path)
    assert stepped == set(task.state_dict()), "the same network, smaller images"


def _shrunk_transfer(config: DictConfig, roots: dict[str, Path]) -> dict[str, Any]:
    """The same for panoramas and photos."""
    root = roots[config.data._target_.rpartition(".")[2]]
    settings = _shrunk(config, root, root)
    photos = {
        "photos.representation.dim": ROWS,
        "photos.data.photos_per_step": 2,
        "photos.data.num_workers": 0,
    }
    if "rooms" in config.data:
        settings |= {"data.rooms.views_per_camera": 1, "data.rooms.view_size": ROWS}
        settings["data.root"] = str(root / config.data.rooms.views)
    return settings | photos


def _first_stages(config: DictConfig, folder: Path) -> dict[str, Stage]:
    stages = plan(config, folder, {})
    return {stage.name: stage for stage in stages if stage.fold == stages[0].fold}


@pytest.mark.parametrize("experiment", TRANSFERS)
def test_every_transfer_composes_and_its_stages_take_a_step(
    experiment: str, photo_roots: dict[str, Path], tmp_path: Path
) -> None:
    config = _composed(experiment, "transfer")
    assert config.name == experiment
    full = _first_stages(config, tmp_path)
    last = list(full)[-1]
    assert last.startswith("S-FT-")
    names = [_builds_at_full_size(OmegaConf.create(full[s].config)) for s in ("P", last)]
    assert names[0] == names[1], "one network for both kinds of images"

    if "frames" in config.data:
        config.data.frames = 2
    for setting, value in _shrunk_transfer(config, photo_roots).items():
        OmegaConf.update(config, setting, value)
    small = _first_stages(config, tmp_path)
    for name in ("P", last):
        stage = OmegaConf.create(small[name].config)
        if "weights" in stage.network:
            stage.network.weights = None
        assert stage.data.root == config.data.root
        _takes_a_step(stage, tmp_path / name)
