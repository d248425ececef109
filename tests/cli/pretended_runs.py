"""Stand-ins for the stages of a transfer, which write the files of real ones at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from tangent_train.cli.transfer import transfer
from tangent_train.config.settings import config_name, validate
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
        configs: Settings of each by the name of the stage; a resumed one has only `resume`.
        failing: A stage that ends with status 7 instead, having begun.
    """

    def __init__(self) -> None:
        self.started: list[tuple[str, str]] = []
        self.configs: dict[str, Any] = {}
        self.failing: str | None = None

    def __call__(self, line: Sequence[str]) -> int:
        command = Path(line[0]).name.removeprefix("tangent-")
        first, *others = line[1:]
        folder = Path(others[-1].partition("=")[2].strip("'\""))
        config: Any = OmegaConf.create({"resume": first.removeprefix("resume=").strip("'")})
        if first.startswith("--config-dir="):
            name = others[0].removeprefix("--config-name=")
            config = OmegaConf.load(Path(first.removeprefix("--config-dir="), f"{name}.yaml"))
            assert config.pop("defaults")
            given = {"init_from": None, "checkpoint": "."}  # files that are not written
            validate(command, {name: given.get(name, v) for name, v in config.items()})
            folder.mkdir(parents=True)
            OmegaConf.save(config, folder / "config.yaml")
        self.started.append((command, folder.name))
        self.configs[folder.name] = config
        if command == "train":
            for name in ("best", "last"):
                path = folder / "checkpoints" / f"{name}.ckpt"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch()
        if folder.name == self.failing:
            return 7
        score = 1.0 if folder.name == "S-FT-1" else 0.5
        record = example_result([score, score], ("wall", "floor"))
        (folder / "results.json").write_text(record.json())
        return 0


def run_transfer(*arguments: str, settings: Sequence[str] = SETTINGS) -> None:
    """Run the command with the given overrides, after those of a small transfer."""
    config_name("transfer", ())
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("transfer", [*settings, *arguments], return_hydra_config=True)
        OmegaConf.set_readonly(config, value=False)
        config.hydra.runtime.output_dir = str(Path(config.hydra.run.dir).absolute())
        HydraConfig.instance().set_config(config)
        transfer(None)
