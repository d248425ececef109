"""Build a run (data module, network, task, trainer) and test it, for training and evaluation."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import yaml  # type: ignore[import-untyped]
from hydra.utils import get_class
from lightning.pytorch.callbacks import (
    BatchSizeFinder,
    Callback,
    LearningRateFinder,
    LearningRateMonitor,
    StochasticWeightAveraging,
)
from lightning.pytorch.callbacks import ProgressBar as LightningProgressBar
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from datamodules.core.image_module import ImageDataModule
from datamodules.core.label_map import DISTANCE, PANOPTIC, PIXEL_CLASSES
from datamodules.core.loading import gathered_order
from models.unet import check_size
from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, CheckpointContents
from tangent_train.callbacks.loggers import start_loggers
from tangent_train.callbacks.pictures import Pictures
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.checkpoints.loaded import (
    METADATA_KEY,
    LoadedNetwork,
    completed_settings,
    declared_sizes,
)
from tangent_train.config.build import build_from_config, filled
from tangent_train.config.from_file import build_from_file
from tangent_train.config.settings import RunSettings
from tangent_train.console import print_text
from tangent_train.errors import SettingError
from tangent_train.files import write_text
from tangent_train.inference.engine import UpLikelihood
from tangent_train.metrics.image_sums import as_sums
from tangent_train.results import evaluation
from tangent_train.results.page import write_report
from tangent_train.results.published import published_rows, published_table
from tangent_train.tasks.optimization import Schedule

# lightning 2.6 uses a function of torch's tree library that torch ≥ 2.13 deprecates.
warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)

_REFUSED = {
    LearningRateFinder: "Compare rates with a sweep: -m optimizer.lr=1e-3,1e-2",
    BatchSizeFinder: "Try values of data.batch_size with debug=fast.",
    StochasticWeightAveraging: "For an average of the weights: ema=0.999",
}
"""Callbacks of Lightning that change a training behind its settings."""


@dataclass(frozen=True)
class Run:
    """A run with its objects.

    Attributes:
        folder: Output folder.
        settings: Settings of the run.
        data: Data module.
        task: Task.
        loaded: Network from a file; None if the network is built from the settings.
        notes: Notes on the label map of that network.
        facts: Further facts of the protocol.
    """

    folder: Path
    settings: RunSettings
    data: Any
    task: Any
    loaded: LoadedNetwork | None = None
    notes: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)

    def trainer(self, callbacks: Sequence[Callback] = ()) -> lightning.Trainer:
        """Build the trainer of the config, with further callbacks, and log the settings."""
        settings, resumed = self.settings, getattr(self.settings, "resume", None)
        loggers = start_loggers(
            None if settings.trainer.get("fast_dev_run") else settings.logger,
            self.folder,
            evaluation.flat_settings(settings.model_dump(mode="json")),
            resumed and self.folder / "checkpoints" / "last.ckpt",
        )
        panels = self.folder / "panels", settings.panels, settings.validation_images
        given = build_callbacks(settings, self.task)
        callbacks = [
            *callbacks,
            *given,
            CheckpointContents(self.contents()),
            *[ProgressBar()] * (not any(isinstance(c, LightningProgressBar) for c in given)),
            Pictures(*panels),
            *[LearningRateMonitor()] * bool(loggers),
        ]
        trainer: lightning.Trainer = build_from_config(
            settings.trainer,
            "trainer",
            default_root_dir=str(self.folder),
            callbacks=callbacks,
            logger=loggers,
            plugins=[AtomicCheckpointIO()],
            use_distributed_sampler=False,  # the samplers of the data count every image once
        )
        return trainer

    def contents(self) -> dict[str, Any]:
        """Return what checkpoints of the run store besides tensors: plain values."""
        return {METADATA_KEY: self.as_loaded().plain()}

    def write_settings(self) -> None:
        """Write ``config.yaml``, the settings, from which `config_name` resumes the run."""
        content = self.settings.model_dump(mode="json")
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        write_text(self.folder / "config.yaml", text)

    def test(self, trainer: lightning.Trainer, checkpoint: Path) -> None:
        """Evaluate the task on the test fold and write the results.

        Args:
            trainer: Trainer of the run.
            checkpoint: File of the network's weights, for the report.
        """
        head, data = self.task.head, self.data
        # Of other networks, upright=auto estimates from the image alone.
        if getattr(data, "upright", None) == "auto" and head.kind == PIXEL_CLASSES:
            data.estimate_up(UpLikelihood(self.as_loaded(), trainer.strategy.root_device))
        trainer.test(self.task, datamodule=data, verbose=False)
        items = data.splits()["test"]
        # Without test batches, `task.result` is that of a validation.
        tested = self.task.evaluated if sum(trainer.num_test_batches) else 0
        if tested == len(items):
            order = gathered_order(tested, trainer.world_size)
            self.report(checkpoint, order, trainer.callbacks)  # type: ignore[attr-defined]
            return
        text = f"{tested} of {len(items)} test {data.noun} were evaluated: no results are written."
        rank_zero_only(print_text)(text)

    def as_loaded(self) -> LoadedNetwork:
        """Return the network of the run with its inputs, classes and representation."""
        if self.loaded is not None:
            return self.loaded
        data, head, settings = self.data, self.task.head, self.settings
        multiple, fixed = declared_sizes(self.task.network)
        sizes = data.in_channels, head.num_outputs
        return LoadedNetwork(
            module=self.task.network,
            predicts=head.kind,
            class_names=data.class_names,
            inputs=getattr(data, "inputs", ()),
            normalization=data.normalization,
            level=settings.level,
            representation=settings.representation,
            image_size=data.representation.image_size,
            size_multiple=multiple,
            fixed_size=fixed,
            depth_kind=getattr(head, "depth_kind", None),
            fill=getattr(data, "fill", None) or "mean",
            settings=completed_settings(settings.network, *sizes, restored=True),
        )

    @rank_zero_only
    def report(self, checkpoint: Path, order: Sequence[int], callbacks: Sequence[Callback]) -> None:
        """Write the results, with the scores of each group of images (`DataModule.groups`).

        Args:
            checkpoint: File of the network's weights, or of predictions.
            order: Index of each image of the test split, in the order of the evaluation.
            callbacks: Callbacks, of which `Pictures` have pictures for the report.
        """
        head, data, task = self.task.head, self.data, self.task
        items, groups = [data.splits()["test"][index] for index in sorted(order)], defaultdict(list)
        for place, files in enumerate(items):
            for group in data.groups(files):
                groups[group].append(place)
        sums = {} if task.result is None else head.image_sums(task.result)
        sums = {name: values[np.argsort(order)] for name, values in sums.items()}
        sums |= as_sums(head.consistency)
        # A relative path stays right when the folder is moved.
        is_inside = checkpoint.is_relative_to(self.folder)
        name = str(checkpoint.relative_to(self.folder) if is_inside else checkpoint)
        result = replace(
            evaluation.evaluation_result(head, task.result, data.noun, len(items), sums, groups),
            protocol={**data.facts, **head.facts, **self.facts},
            checkpoint=name,
            label_map=self.settings.model_dump(mode="json").get("label_map"),
            folds=data.folds,
            settings=evaluation.flat_settings(self.settings.model_dump(mode="json")),
        )
        source = "Checkpoint" if task.network is not None else "Predictions"
        notes, tables = [f"{source}: {name}", *self.notes], evaluation.result_tables(result)
        summary, (rows, sources) = evaluation.summary_lines(result), published_rows([result])
        published = [published_table(rows, result)] if rows else []
        evaluation.write_image_sums(self.folder, [files.name for files in items], sums)
        evaluation.write_results(result, self.folder, [*notes, *sources], published)
        network = source if task.network is None else type(self.as_loaded().module).__name__
        images = [i for c in callbacks if isinstance(c, Pictures) for i in c.images]
        shown = [f"Shown: {len(images)} of {result.images} {data.noun}, the worst first."]
        write_report(
            self.folder / "report.html",
            f"{network} on {data.facts['data']} ({checkpoint.name})",
            tables=[*tables, *([evaluation.confusion_table(result)] if result.confusion else [])],
            images=images,
            class_names=head.class_names,
            notes=[*summary, *notes, *shown * bool(images)],
        )
        print_text("\n".join([*self.notes, *summary]))
        for table in tables[:2]:
            table.print()
        print_text(f"Results, pictures and logs: {self.folder}; report.html opens in a browser.")


def build(settings: RunSettings, file: Path | None = None, trust: Sequence[str] = ()) -> Any:
    """Build the data module and the task of a training.

    Network settings that are null are taken from the data: ``in_channels``, and ``num_classes`` or
    ``classes``, also of a network inside the network's settings.

    Args:
        settings: Settings of the run.
        file: File that ``settings.network`` comes from; None if it is the user's.
        trust: Packages whose classes the file may name.

    Returns:
        Data module and task.

    Raises:
        SettingError: A setting, or a combination of settings, is invalid.
    """
    if _needed_labels(settings) == PANOPTIC:
        expected = "task=segmentation: objects are evaluated, not trained"
        raise SettingError("task", found=PANOPTIC, expected=expected)
    data = build_data(settings)
    head = build_head(settings, data)
    # Pretrained weights are not fetched if a checkpoint replaces them.
    restored = getattr(settings, "resume", None) is not None
    sizes = data.in_channels, head.num_outputs
    section = completed_settings(settings.network, *sizes, restored=restored)
    if file is None:
        network = build_from_config(section, "network")
    else:
        network = build_from_file(section, "network", file, trust)
    check_size(data.representation.image_size, network, *declared_sizes(network))
    return data, build_task(settings, data, network, head)


def _needed_labels(settings: RunSettings) -> Any:
    """Return the kind of labels of the task."""
    return get_class(settings.task["head"]["_target_"]).labels  # type: ignore[attr-defined]


def open_data(settings: RunSettings) -> Any:
    """Build the data module of a run; images have the kind of labels that the task needs."""
    representation = build_from_config(settings.representation, "representation")
    is_images = issubclass(get_class(settings.data["_target_"]), ImageDataModule)
    needed = _needed_labels(settings)
    given = {"labels": needed} if is_images and needed in (DISTANCE, PANOPTIC) else {}
    return build_from_config(settings.data, "data", representation=representation, **given)


def build_data(settings: RunSettings) -> Any:
    """Build the data module of a run, and check that it has the labels of the task."""
    data: Any = open_data(settings)
    needed = _needed_labels(settings)
    labels = getattr(data, "labels", "pairs, which is tangent-keypoints")
    if needed != labels:
        expected = f"a task for {labels}, the labels of {type(data).__name__}"
        raise SettingError("task", found=f"a task for {needed}", expected=expected)
    return data


def build_head(settings: RunSettings, data: Any, depth_kind: str | None = None) -> Any:
    """Build the head of a run; `depth_kind` is that of a network from a file."""
    given = {} if depth_kind is None else {"depth_kind": depth_kind}
    given |= {"things": data.things} if data.labels == PANOPTIC else {}
    section = settings.task["head"]
    return build_from_config(section, "task.head", class_names=data.class_names, **given)


def build_task(settings: RunSettings, data: Any, network: nn.Module, head: Any) -> Any:
    """Build the task of a run."""
    optimizer = build_from_config(settings.optimizer, "optimizer")  # the schedule has its rate
    scheduler = None
    if settings.scheduler is not None:
        section = dict(settings.scheduler)
        timing = {n: section.pop(n) for n in ("interval", "frequency", "monitor") if n in section}
        scheduler = Schedule(build_from_config(section, "scheduler"), **timing)
    return build_from_config(
        {name: value for name, value in settings.task.items() if name != "head"},
        "task",
        network=network,
        representation=data.representation,
        head=head,
        optimizer=optimizer,
        scheduler=scheduler,
    )


def build_callbacks(settings: RunSettings, task: Any) -> list[Any]:
    """Build the callbacks; a null ``monitor`` is the score that selects the best epoch."""
    built = []
    for name, section in (settings.callbacks or {}).items():
        monitor = section.get("monitor") or task.monitor
        known = {"monitor": monitor, "mode": task.head.mode_of(monitor)}
        built.append(build_from_config(filled(section, known), f"callbacks.{name}"))
        if remedy := next((text for of, text in _REFUSED.items() if isinstance(built[-1], of)), ""):
            found, expected = type(built[-1]).__name__, "a callback that can be resumed and tested"
            raise SettingError(f"callbacks.{name}", found=found, expected=expected, remedy=remedy)
    return built
