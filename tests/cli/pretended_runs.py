"""Stand-ins for the stages of a transfer, which write the files of real ones at once."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from tangent_train.checkpoints.content import write_settings
from tangent_train.cli.command_settings import check_settings
from tangent_train.cli.transfer import transfer
from tangent_train.files import config_folder
from tests.cli.tiny_runs import SMALL_ROOMS
from tests.results.example_results import example_result

SETTINGS = (
    "experiment=rooms/transfer",
    "name=mine",
    *SMALL_ROOMS,
    "data.rooms.views_per_camera=2",
    "data.rooms.view_size=32",
    "representation.faces_per_panorama=4",
    "optimizer.lr=3e-3",
    "fine_tuning.epochs=[1]",
    "photos.representation.dim=null",
    "trainer.max_epochs=20",
    "panels=0",
)
HERE = Path("runs/transfer/mine")
OF_SEED_0 = HERE / "fold_1" / "seed_0"


class PretendedRuns:
    """In place of processes: leaves what a run leaves; S-FT-1's mIoU is twice that of the others.

    Attributes:
        started: Command and folder name of each, in order.
        configs: The ``stage.yaml`` of each.
        failing: A stage that ends with status 7 instead, having begun.
    """

    def __init__(self) -> None:
        self.started: list[tuple[str, str]] = []
        self.configs: list[Any] = []
        self.failing: str | None = None

    def __call__(self, line: Sequence[str]) -> int:
        assert list(line[:3]) == [sys.executable, "-m", "tangent_train.cli.main"]
        command, config_dir, _, _ = line[3:]
        folder = Path(config_dir.removeprefix("--config-dir="))
        config: Any = OmegaConf.load(folder / "stage.yaml")
        assert config.pop("defaults")
        self.started.append((command, folder.name))
        self.configs.append(config)
        settings: Any = OmegaConf.to_container(config, resolve=True)
        check_settings(command, settings, ())
        write_settings(folder / "config.yaml", settings)
        if command == "train":
            (folder / "checkpoints").mkdir(exist_ok=True)
            for name in ("best", "last"):
                path = folder / "checkpoints" / f"{name}.ckpt"
                path.write_text(f"{config.name} {config.seed}")
        if folder.name == self.failing:
            return 7
        score = 1.0 if folder.name == "S-FT-1" else 0.5
        record = example_result([score, score], ("wall", "floor"))
        (folder / "results.json").write_text(record.json())
        return 0


@lru_cache
def _composed() -> Any:
    return compose("transfer", list(SETTINGS), return_hydra_config=True)


def run_transfer(*arguments: str) -> None:
    """The command on a config that is composed once: this takes Hydra a second."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = _composed().copy()
        OmegaConf.set_struct(config, value=False)
        config.merge_with_dotlist(list(arguments))
        config.hydra.overrides.task = list(arguments)
        config.hydra.runtime.output_dir = str(Path(config.hydra.run.dir).absolute())
        HydraConfig.instance().set_config(config)
        del config["hydra"]
        transfer(config)
