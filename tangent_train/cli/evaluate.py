"""``tangent-evaluate``: a checkpoint on the test fold of its data; also the end of a training."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from datamodules.core.loading import explained
from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, CheckpointContents
from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.callbacks.tensorboard import ClassScores, ValidationPictures
from tangent_train.checkpoints.content import read_checkpoint, write_settings
from tangent_train.checkpoints.scores import ClassScoreNetwork, size_multiple_of
from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.cli.build import Settings, build, build_trained, check_fits, shown
from tangent_train.cli.command_settings import EvaluateSettings
from tangent_train.cli.settings import parse_settings
from tangent_train.cli.stored import GROUPS, run_settings
from tangent_train.console import print_text
from tangent_train.errors import SettingError, at_least
from tangent_train.files import no_room
from tangent_train.inference.judge import NetworkJudge
from tangent_train.registry import SettingsFile, build_from_config
from tangent_train.results.evaluation import (
    classification_record,
    confusion_table,
    headline,
    result_tables,
    segmentation_record,
    write_results,
)
from tangent_train.results.html import write_report
from tangent_train.results.record import Record

# lightning 2.6 asks torch's tree library in a way torch ≥ 2.13 deprecates: nothing to do about it.
warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)


def evaluate(
    settings: Settings,
    source: SettingsFile | None = None,
    trained: TrainedNetwork | None = None,
) -> None:
    """Evaluate a checkpoint on the test fold of its data.

    Args:
        settings: Of the run, and ``checkpoint``, ``class_map`` and ``unmapped``; all there are for
            a stage of a transfer.
        source: The file they come from, see `registry.build_from_config`.
        trained: The network of a file that has no settings of a run, if it was loaded for these.

    Raises:
        SettingError: No checkpoint is given, or it does not fit the data.
    """
    checkpoint = parse_settings(EvaluateSettings, settings).checkpoint
    mapped = settings.get("class_map") is not None
    if not mapped:
        settings = {name: value for name, value in settings.items() if name != "unmapped"}
    if trained is None and (mapped or run_settings(checkpoint) is None):
        trained = load_trained(checkpoint, settings.get("trust", ()))
    run = Run.begin(settings, source, trained, trains=False)
    with machine_faults(run.folder, run.data):
        run.test(run.trainer([]), checkpoint)


@dataclass(frozen=True)
class Run:
    """A run with its objects.

    Attributes:
        folder: Output folder.
        settings: Settings kept in its checkpoints.
        source: File they come from; None for the user's own.
        data: The data module.
        task: The task.
        trained: Its network, if that is not made from the settings.
        notes: On the classes of that network.
    """

    folder: Path
    settings: Settings
    source: SettingsFile | None
    data: Any
    task: Any
    trained: TrainedNetwork | None = None
    notes: Sequence[str] = ()

    @staticmethod
    def begin(
        settings: Settings,
        source: SettingsFile | None,
        trained: TrainedNetwork | None = None,
        *,
        trains: bool = True,
    ) -> Run:
        """Build the objects, and write the settings to the run's folder.

        Args:
            settings: Of the run.
            source: The file they come from.
            trained: Network to evaluate; None to make it from the settings.
            trains: False if the task is only evaluated, see `build`.
        """
        folder = Path(HydraConfig.get().runtime.output_dir)
        lightning.seed_everything(
            at_least("seed", settings["seed"], 0), workers=True, verbose=False
        )
        notes: list[str] = []
        if trained is None:
            data, task = build(settings, source, trains=trains)
        else:
            data, task, notes = build_trained(settings, trained, source)
        kept = {n: value for n, value in settings.items() if n not in ("choices", "trust")}
        kept = {"choices": _choices(settings, source), **kept}
        run = Run(folder, kept, source, data, task, trained, notes)
        write_settings(folder / "config.yaml", run.settings)
        return run

    def trainer(self, callbacks: Sequence[Callback]) -> lightning.Trainer:
        """The trainer of the config, with callbacks besides those of every run."""
        contents = {"kind": self.task.kind, "config": self.settings, **shown(self.data)}
        common = [CheckpointContents(contents), ProgressBar(), ClassScores()]
        if self.task.kind == "segmentation":
            common.append(PredictionPanels(self.folder / "panels", self.settings["panels"]))
            common.append(ValidationPictures(self.settings["tensorboard_images"]))
        section = self.settings["trainer"]
        # Devices found, advertisements, what the settings say anyway.
        logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
        every, epochs = section.get("check_val_every_n_epoch"), section.get("max_epochs")
        if epochs not in (None, -1):
            at_least("trainer.max_epochs", epochs, 1)
        return build_from_config(
            section,
            "trainer",
            self.source,
            # A run shorter than that is validated at its end.
            check_val_every_n_epoch=min(every, epochs) if every and (epochs or -1) > 0 else every,
            default_root_dir=str(self.folder),
            callbacks=[*callbacks, *common],
            logger=TensorBoardLogger(self.folder, name="", version="tensorboard"),
            plugins=[AtomicCheckpointIO()],
            # The data module's samplers count every image once on any number of processes.
            use_distributed_sampler=False,
        )

    def test(self, trainer: lightning.Trainer, checkpoint: Path) -> None:
        """Evaluate weights on the test fold and write the results.

        Raises:
            SettingError: The data or the network do not match the weights.
        """
        if self.trained is None:
            content = read_checkpoint(checkpoint)
            check_fits(self.data, content, checkpoint)
            self._load(content["state_dict"], checkpoint)
        if getattr(self.data, "upright", None) == "auto":
            self.data.judge = NetworkJudge(self._as_trained(), trainer.strategy.root_device)
        trainer.test(self.task, datamodule=self.data, verbose=False)
        task, noun = self.task, self.data.noun
        if task.kind == "classification":
            record = classification_record(task.matrices, task.class_names, noun)
        else:
            names, absent = task.class_names, task.absent_class
            record = segmentation_record(task.matrices, names, absent, noun)
        total = len(self.data.source("test"))
        if record.images != total:
            raise RuntimeError(f"{record.images} of {total} test {noun} were counted")
        self._report(record, checkpoint, trainer.callbacks)  # type: ignore[attr-defined]

    def _as_trained(self) -> TrainedNetwork:
        """The network of the run, with what it was trained on."""
        if self.trained is not None:
            return self.trained
        data = self.data
        network = ClassScoreNetwork(self.task.network, data.num_classes).eval()
        return TrainedNetwork(
            inner=self.task.network,
            class_names=data.class_names,
            inputs=data.inputs,
            normalization=data.normalization,
            level=self.settings["level"],
            representation=self.settings["representation"],
            image_size=data.representation.image_size,
            size_multiple=size_multiple_of(network, data.in_channels) or 1,
            source=self.source,
        )

    def _load(self, tensors: Mapping[str, Any], checkpoint: Path) -> None:
        try:
            self.task.load_state_dict(tensors)
        except RuntimeError as error:
            raise SettingError(
                "network",
                found=f"other tensors than in {checkpoint} ({error})",
                expected="the network and inputs of the checkpoint",
            ) from error

    @rank_zero_only
    def _report(self, record: Record, checkpoint: Path, callbacks: Sequence[Callback]) -> None:
        own = checkpoint.is_relative_to(self.folder)  # so that a run tells the same wherever it is
        name = str(checkpoint.relative_to(self.folder) if own else checkpoint)
        record = replace(record, checkpoint=name, class_map=self.settings.get("class_map"))
        notes = [f"Checkpoint: {name}", *self.notes]
        write_results(record, self.folder, notes)
        write_report(
            self.folder / "report.html",
            f"Evaluation of {checkpoint.name}",
            tables=[*result_tables(record), confusion_table(record)],
            images=[i for c in callbacks if isinstance(c, PredictionPanels) for i in c.images],
            class_names=self.task.class_names,
            notes=[headline(record), *notes],
        )
        for line in (*self.notes, headline(record)):
            print_text(line)
        result_tables(record)[0].print()
        print_text(f"Results, pictures and logs: {self.folder}; report.html opens in a browser.")


def _choices(settings: Settings, source: SettingsFile | None) -> dict[str, str]:
    """The chosen options of config groups, without those in whose place a file gave a section."""
    chosen, stored = HydraConfig.get().runtime.choices, settings.get("choices") or ()
    return {
        group: chosen[group]
        for group in GROUPS
        if chosen.get(group)
        and (source is None or group in stored or group == "experiment" or not source.owns(group))
    }


@contextmanager
def machine_faults(folder: Path, data: Any) -> Iterator[None]:
    """Explain a full disk, and workers that died.

    Args:
        folder: Of the run.
        data: Its data module.

    Raises:
        NoRoomError: The disk is full for a file that is not written atomically, as TensorBoard's
            events.
        DataError: A worker died.
    """
    try:
        yield
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        told = no_room(folder, error) or explained(error, data.num_workers)
        if told is error:
            raise
        raise told from error
