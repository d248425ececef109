"""Build a run (data module, network, task, trainer) and test it, for training and evaluation."""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning
from hydra.utils import get_class
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from datamodules.core.data_module import DataModule
from datamodules.core.image_module import ImageDataModule
from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from datamodules.core.loading import gathered_order
from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, CheckpointContents
from tangent_train.callbacks.pictures import Pictures
from tangent_train.callbacks.progress import ProgressBar
from tangent_train.checkpoints.loaded import (
    METADATA_KEY,
    LoadedNetwork,
    completed_settings,
    declared_sizes,
)
from tangent_train.config.build import build_from_config
from tangent_train.config.from_file import build_from_file
from tangent_train.config.settings import RunSettings
from tangent_train.console import print_text
from tangent_train.errors import SettingError
from tangent_train.files import write_text
from tangent_train.inference.engine import UpLikelihood
from tangent_train.results.evaluation import (
    EvaluationResult,
    confusion_table,
    evaluation_result,
    flat_settings,
    plain_scores,
    result_tables,
    summary_lines,
    write_results,
)
from tangent_train.results.page import write_report
from tangent_train.results.published import published_rows, published_table
from tangent_train.tasks.optimization import Schedule

# lightning 2.6 uses a function of torch's tree library that torch ≥ 2.13 deprecates.
warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)


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
    """

    folder: Path
    settings: RunSettings
    data: Any
    task: Any
    loaded: LoadedNetwork | None = None
    notes: Sequence[str] = ()

    def trainer(self, callbacks: Sequence[Callback] = ()) -> lightning.Trainer:
        """Build the trainer of the config, with further callbacks, and log the settings."""
        loggers = build_loggers(self.settings, self.folder)
        trainer: lightning.Trainer = build_from_config(
            self.settings.trainer,
            "trainer",
            default_root_dir=str(self.folder),
            callbacks=[
                *callbacks,
                *build_callbacks(self.settings, self.task),
                CheckpointContents(self.contents()),
                ProgressBar(),
                Pictures(
                    self.folder / "panels", self.settings.panels, self.settings.validation_images
                ),
                *[LearningRateMonitor()] * bool(loggers),
            ],
            logger=loggers,
            plugins=[AtomicCheckpointIO()],
            use_distributed_sampler=False,  # the samplers of the data count every image once
        )
        for logger in trainer.loggers:
            logger.log_hyperparams(flat_settings(self.plain_settings()))
        return trainer

    def plain_settings(self) -> dict[str, Any]:
        """Return the settings as plain values."""
        return self.settings.model_dump(mode="json")

    def contents(self) -> dict[str, Any]:
        """Return what checkpoints of the run store besides tensors: plain values."""
        # Without loggers, whose settings may hold a server's address: checkpoints are passed on.
        return {
            METADATA_KEY: self.as_loaded().plain(),
            "config": {name: v for name, v in self.plain_settings().items() if name != "logger"},
            **inputs_and_classes(self.data),
        }

    def test(self, trainer: lightning.Trainer, checkpoint: Path) -> None:
        """Evaluate the task on the test fold and write the results.

        Args:
            trainer: Trainer of the run.
            checkpoint: File of the network's weights, for the report.
        """
        by_classes = self.task.head.kind == PIXEL_CLASSES  # else upright=auto is by the image alone
        if getattr(self.data, "upright", None) == "auto" and by_classes:
            self.data.estimate_up(UpLikelihood(self.as_loaded(), trainer.strategy.root_device))
        trainer.test(self.task, datamodule=self.data, verbose=False)
        noun, total = self.data.noun, len(self.data.dataset("test"))
        tested = sum(trainer.num_test_batches) > 0  # else `task.result` is that of a validation
        of_task = self.task.head, self.task.result, noun, self.task.evaluated
        result = evaluation_result(*of_task) if tested else None
        if result and result.images == total:
            result = replace(result, groups=self._groups(trainer.world_size))
            self._report(result, checkpoint, trainer.callbacks)  # type: ignore[attr-defined]
            return
        rank_zero_only(print_text)(
            f"{result.images if result else 0} of {total} test {noun} were evaluated: no results "
            "are written."
        )

    def _groups(self, world_size: int) -> list[dict[str, Any]]:
        """Return the scores of each group of test images, see `LabeledData.groups`."""
        items, places = self.data.splits()["test"], defaultdict(list)
        for place, index in enumerate(gathered_order(len(items), world_size)):
            for group in self.data.groups(items[index]):
                places[group].append(place)
        return [
            {"group": group, "images": len(some)}
            | plain_scores(self.task.head.scores_of(self.task.result, some))
            for group, some in sorted(places.items())
        ]

    def as_loaded(self) -> LoadedNetwork:
        """Return the network of the run with its inputs, classes and representation."""
        if self.loaded is not None:
            return self.loaded
        data, module, settings = self.data, self.task.network, self.settings
        channels, outputs = data.in_channels, self.task.head.num_outputs
        multiple, fixed = declared_sizes(module)
        return LoadedNetwork(
            module=module,
            predicts=self.task.head.kind,
            class_names=data.class_names,
            inputs=getattr(data, "inputs", ()),
            normalization=data.normalization,
            level=settings.level,
            representation=settings.representation,
            image_size=data.representation.image_size,
            size_multiple=multiple,
            fixed_size=fixed,
            depth_kind=getattr(self.task.head, "depth_kind", None),
            fill=getattr(data, "fill", None) or "mean",
            settings=completed_settings(settings.network, channels, outputs, restored=True),
        )

    @rank_zero_only
    def _report(
        self, result: EvaluationResult, checkpoint: Path, callbacks: Sequence[Callback]
    ) -> None:
        is_inside = checkpoint.is_relative_to(self.folder)
        # A relative path stays right when the folder is moved.
        name = str(checkpoint.relative_to(self.folder) if is_inside else checkpoint)
        result = replace(
            result,
            protocol={**self.data.facts, **self.task.head.facts},
            checkpoint=name,
            label_map=self.plain_settings().get("label_map"),
            folds=self.data.folds,
            settings=flat_settings(self.plain_settings()),
        )
        notes, tables = [f"Checkpoint: {name}", *self.notes], result_tables(result)
        summary, (rows, sources) = summary_lines(result), published_rows([result])
        published = [published_table(rows, result)] if rows else []
        write_results(result, self.folder, [*notes, *sources], published)
        write_report(
            self.folder / "report.html",
            f"Evaluation of {checkpoint.name}",
            tables=[*tables, *([confusion_table(result)] if result.confusion else [])],
            images=[i for c in callbacks if isinstance(c, Pictures) for i in c.images],
            class_names=self.task.head.class_names,
            notes=[*summary, *notes],
        )
        for line in (*self.notes, *summary):
            print_text(line)
        tables[0].print()
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
    data = build_data(settings)
    head = build_head(settings, data)
    # Pretrained weights are not fetched if a checkpoint replaces them.
    restored = getattr(settings, "resume", None) is not None
    section = completed_settings(
        settings.network, data.in_channels, head.num_outputs, restored=restored
    )
    if file is None:
        network = build_from_config(section, "network")
    else:
        network = build_from_file(section, "network", file, trust)
    return data, build_task(settings, data, network, head)


def open_data(settings: RunSettings) -> Any:
    """Build the data module of a run; images have distances as labels if the task needs them."""
    representation = build_from_config(settings.representation, "representation")
    is_images = issubclass(get_class(settings.data["_target_"]), ImageDataModule)
    has_distances = is_images and _head_class(settings).labels == DISTANCE
    given = {"labels": DISTANCE} if has_distances else {}
    return build_from_config(settings.data, "data", representation=representation, **given)


def build_data(settings: RunSettings) -> Any:
    """Build the data module of a run, and check that it has the labels of the task."""
    data = open_data(settings)
    if not isinstance(data, DataModule):
        expected = "labeled images or shapes; pairs are for tangent-keypoints"
        raise SettingError("data", found=type(data).__name__, expected=expected)
    needed = _head_class(settings).labels
    if needed != data.labels:
        raise SettingError(
            "task",
            found=f"a task for {needed}",
            expected=f"a task for {data.labels}, the labels of {type(data).__name__}",
        )
    return data


def build_head(settings: RunSettings, data: Any, depth_kind: str | None = None) -> Any:
    """Build the head of a run; `depth_kind` is that of a network from a file."""
    given = {} if depth_kind is None else {"depth_kind": depth_kind}
    section = settings.task["head"]
    return build_from_config(section, "task.head", class_names=data.class_names, **given)


def build_task(settings: RunSettings, data: Any, network: nn.Module, head: Any) -> Any:
    """Build the task of a run."""
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
        optimizer=build_from_config(settings.optimizer, "optimizer"),
        scheduler=scheduler,
    )


def _head_class(settings: RunSettings) -> Any:
    return get_class(settings.task["head"]["_target_"])


def check_fits(data: Any, network: Mapping[str, Any], name: object) -> None:
    """Refuse data whose inputs or classes differ from those of a network.

    Args:
        data: Data module.
        network: `inputs_and_classes` of the network; further fields are ignored.
        name: Name of the network, for the message.

    Raises:
        SettingError: Inputs or classes differ.
    """
    for field, value in inputs_and_classes(data).items():
        if network[field] != value:
            raise SettingError(
                f"data, for {name}",
                found=f"{field.replace('_', ' ')} {value}",
                expected=f"{network[field]}, which the network was trained with",
                remedy="Map classes with label_map=." if field == "class_names" else "",
            )


def inputs_and_classes(data: Any) -> dict[str, Any]:
    """Return inputs and classes of a data module or a `LoadedNetwork` as plain values."""
    mean, std = list(data.normalization.mean), list(data.normalization.std)
    inputs = {"inputs": list(data.inputs)} if hasattr(data, "inputs") else {}
    names = list(data.class_names)
    return {"class_names": names, **inputs, "normalization": {"mean": mean, "std": std}}


def build_loggers(settings: RunSettings, folder: Path) -> list[Any]:
    """Build the loggers; null folders and names are those of the run.

    The run is named after its folder below ``runs``, the group after the folder that contains it.
    """
    above, _, below = folder.absolute().as_posix().rpartition("/runs/")
    parts = below.split("/") if above else folder.absolute().parts[-2:]
    name = "/".join(parts)
    group = "/".join(part for part in parts[:-1] if not re.fullmatch(r"(fold|seed)_\d+", part))
    known = {"save_dir": str(folder), "name": name, "run_name": name, "group": group}
    sections = (settings.logger or {}).items()
    return [
        build_from_config(_filled(section, known), f"logger.{name}") for name, section in sections
    ]


def build_callbacks(settings: RunSettings, task: Any) -> list[Any]:
    """Build the callbacks; a null ``monitor`` is the score that selects the best epoch."""
    built = []
    for name, section in (settings.callbacks or {}).items():
        monitor = section.get("monitor") or task.monitor
        known = {"monitor": monitor, "mode": task.head.mode_of(monitor)}
        built.append(build_from_config(_filled(section, known), f"callbacks.{name}"))
    return built


def _filled(section: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Replace null settings by known values, also in inner sections."""
    return {
        name: _filled(value, known)
        if isinstance(value, Mapping)
        else (known.get(name) if value is None else value)
        for name, value in section.items()
    }


def write_settings(folder: Path, settings: RunSettings) -> None:
    """Write ``config.yaml``, the settings of a run, from which `config_name` resumes it."""
    import yaml  # type: ignore[import-untyped]

    content = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_text(folder / "config.yaml", content)
