"""One process of ``python -m benchmarks accuracy``: makes rooms, times epochs, or trains a row.

As ``python -m benchmarks.accuracy_run rooms|speed|run <folder> [<row> <seed>]``.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import lightning
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Callback
from omegaconf import DictConfig

from benchmarks.accuracy_folder import AccuracyFolder, results_of
from benchmarks.accuracy_rows import ROWS, Row
from tangent_train.cli.build import build
from tangent_train.cli.compose import config_folder
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path
from tangent_train.tasks.averaging import AveragedWeights

MEASURED_S = 5.0
"""Epochs are measured until it took so long."""
MEASURED_EPOCHS = 5
"""At most so many."""
TEST_SEED = 0
"""Seed of the turns of the test panoramas: the same for all runs."""


def main(arguments: list[str]) -> None:
    """Do one of them.

    Args:
        arguments: What, and of which run.
    """
    what, path, *run = arguments
    folder = AccuracyFolder(Path(path))
    if torch.get_num_threads() == 1:
        cv2.setNumThreads(0)
    if what == "rooms":
        build(composed(folder.plan().overrides()))[0].prepare_all()
        return
    row = ROWS[run[0]]
    if what == "speed":
        folder.write_speed(row, measured_speed(folder, row))
    else:
        train_and_evaluate(folder, row, int(run[1]))


def composed(overrides: tuple[str, ...]) -> DictConfig:
    """The config of ``tangent-train`` with these overrides."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("train", list(overrides))


class EpochClock(Callback):
    """How long epochs take, and what the first one consists of.

    Without a GPU and without worker processes it counts the time that this process computes: what
    else the machine does then changes little.

    Args:
        config: Of the run.
        enough_s: End the training when all epochs but the first took so long; None to go on.

    Attributes:
        seconds: Of every epoch.
        wall_seconds: The same by the clock on the wall.
        counts: Steps, panoramas, images and pixels of the first epoch.
    """

    def __init__(self, config: DictConfig, enough_s: float | None = None) -> None:
        self.seconds: list[float] = []
        self.wall_seconds: list[float] = []
        self.counts = dict.fromkeys(("steps", "panoramas", "images", "pixels"), 0)
        self._enough_s = enough_s
        self._cuda = config.trainer.accelerator == "cuda"
        alone = not self._cuda and not config.data.num_workers
        self._clock = time.process_time if alone else time.perf_counter
        self._start = self._wall_start = 0.0

    def on_train_epoch_start(self, *_: Any) -> None:
        """Start the clock."""
        self._start, self._wall_start = self._now(), time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Count the first epoch."""
        if not self.seconds:
            panoramas, images, _, height, width = batch.images.shape
            found = (1, panoramas, panoramas * images, panoramas * images * height * width)
            for name, count in zip(self.counts, found, strict=True):
                self.counts[name] += count

    def on_train_epoch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Stop it; perhaps the training too."""
        self.seconds.append(self._now() - self._start)
        self.wall_seconds.append(time.perf_counter() - self._wall_start)
        if self._enough_s is not None and sum(self.seconds[1:]) >= self._enough_s:
            trainer.should_stop = True

    def _now(self) -> float:
        if self._cuda:
            torch.cuda.synchronize()
        return self._clock()


def trained(config: DictConfig, clock: EpochClock) -> Any:
    """The task of a config after its training, as ``tangent-train`` would train it."""
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    data, task = build(config)
    callbacks: list[Callback] = [clock]
    if config.ema is not None:
        callbacks.append(AveragedWeights(config.ema))
    _trainer(config, callbacks).fit(task, datamodule=data)
    return task


def _trainer(config: DictConfig, callbacks: list[Callback]) -> lightning.Trainer:
    trainer: lightning.Trainer = instantiate(
        config.trainer,
        callbacks=callbacks,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        use_distributed_sampler=False,
    )
    return trainer


def measured_speed(folder: AccuracyFolder, row: Row) -> dict[str, Any]:
    """What an epoch of a row takes, after one to warm up: the median of some."""
    plan = folder.plan()
    epochs = f"trainer.max_epochs={1 + MEASURED_EPOCHS}"
    config = composed((*plan.overrides(), *row.settings, *plan.on_device(), epochs))
    clock = EpochClock(config, MEASURED_S)
    network = trained(config, clock).network
    measured = clock.seconds[1:]
    return {
        "epoch_seconds": statistics.median(measured),
        "measured": measured,
        "wall": clock.wall_seconds[1:],
        **clock.counts,
        "parameters": sum(p.numel() for p in network.parameters()),
        "device": torch.cuda.get_device_name() if plan.device == "cuda" else "one thread",
        "torch": torch.__version__,
    }


def train_and_evaluate(folder: AccuracyFolder, row: Row, seed: int) -> None:
    """Do what is not done yet of a run."""
    plan = folder.plan()
    overrides = (*plan.overrides(), *row.settings, *plan.on_device())
    run, weights = folder.run(row, seed), folder.run_folder(row, seed) / "weights.pt"
    if run is None or not weights.exists():
        settings = (f"seed={seed}", f"trainer.max_epochs={folder.epochs(row)}")
        run = {"training": _train((*overrides, *settings), weights), "evaluations": {}}
        folder.write_run(row, seed, run)
    state = torch.load(weights, weights_only=True)
    for variant, orientation in folder.lacking(row, seed):
        of_test = (f"data.test_rotation={orientation}", f"data.seed={TEST_SEED}")
        results = evaluated((*overrides, *variant.settings, *of_test), state)
        before = results_of(run, variant)
        run["evaluations"][variant.name] = {
            "settings": list(variant.settings),
            "results": {**before, orientation: results},
        }
        folder.write_run(row, seed, run)


def _train(overrides: tuple[str, ...], weights: Path) -> dict[str, Any]:
    config = composed(overrides)
    clock = EpochClock(config)
    task = trained(config, clock)
    with atomic_path(weights) as temporary:
        torch.save({name: value.cpu() for name, value in task.state_dict().items()}, temporary)
    return {"epochs": len(clock.seconds), "seconds": sum(clock.seconds)}


def evaluated(overrides: tuple[str, ...], state: dict[str, torch.Tensor]) -> dict[str, Any]:
    """The results of weights on the test panoramas, as ``tangent-evaluate`` would find them.

    Args:
        overrides: Of the run and of the evaluation.
        state: All tensors of the task.
    """
    config = composed(overrides)
    data, task = build(config)
    task.load_state_dict(state)
    _trainer(config, []).test(task, datamodule=data, verbose=False)
    results: dict[str, Any] = task.results(data.noun)
    total = len(data.source("test"))
    if results["images"] != total:
        raise RuntimeError(f"{results['images']} of {total} test panoramas were counted")
    del results["confusion"]
    return results


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (DataError, SettingError) as error:
        sys.exit(str(error))
    except InstantiationException as error:
        if isinstance(error.__cause__, DataError | SettingError):
            sys.exit(str(error.__cause__))
        raise
