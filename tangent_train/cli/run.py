"""Build a run (folder, settings, data module, task) and test it, for training and evaluation."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from datamodules.core.data_module import DataModule
from datamodules.core.image_module import ImageDataModule
from datamodules.core.labels import DISTANCE, PIXEL_CLASSES
from datamodules.core.loading import explained, gathered_order
from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.checkpoints.content import read_checkpoint, write_settings
from tangent_train.checkpoints.loaded import LoadedNetwork, completed_settings
from tangent_train.checkpoints.scores import ClassScoreNetwork, size_multiple_of
from tangent_train.cli.command_settings import LabelMapSettings
from tangent_train.cli.settings import parse_settings
from tangent_train.cli.stored import GROUPS
from tangent_train.cli.trainer import build_trainer
from tangent_train.cli.trials import try_network, try_training
from tangent_train.config.build import (
    SettingsFile,
    build_from_config,
    named_arguments,
    resolve_target,
)
from tangent_train.config.setting_rules import flat_settings
from tangent_train.console import print_text
from tangent_train.errors import SettingError, at_least
from tangent_train.files import no_room
from tangent_train.inference.judge import NetworkJudge
from tangent_train.inference.label_maps import load_label_map, map_classes
from tangent_train.inference.representations import check_size
from tangent_train.results.evaluation import (
    confusion_table,
    result_tables,
    summary_lines,
    write_results,
)
from tangent_train.results.evaluation_result import EvaluationResult, plain_scores
from tangent_train.results.html import write_report
from tangent_train.results.published import published_rows, published_table
from tangent_train.tasks.schedules import Schedule

# lightning 2.6 uses a function of torch's tree library that torch ≥ 2.13 deprecates.
warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)`", FutureWarning)


@dataclass(frozen=True)
class Run:
    """A run with its objects.

    Attributes:
        folder: Output folder.
        settings: Settings stored in its checkpoints.
        source: File that settings come from; None if all are the user's.
        data: Data module.
        task: Task.
        trained: Network from a file; None if the network is built from the settings.
        notes: Notes on the label map of that network.
    """

    folder: Path
    settings: Mapping[str, Any]
    source: SettingsFile | None
    data: Any
    task: Any
    trained: LoadedNetwork | None = None
    notes: Sequence[str] = ()

    @staticmethod
    def create(
        settings: Mapping[str, Any],
        source: SettingsFile | None,
        trained: LoadedNetwork | None = None,
        *,
        trains: bool = True,
    ) -> Run:
        """Build the objects, and write the settings to the run's folder.

        Args:
            settings: Settings of the run.
            source: File that settings come from.
            trained: Network to evaluate; None to build it from the settings.
            trains: True if the task is trained, see `build`.
        """
        folder = Path(HydraConfig.get().runtime.output_dir)
        seed = at_least("seed", settings["seed"], 0)
        lightning.seed_everything(seed, workers=True, verbose=False)
        notes: list[str] = []
        if trained is None:
            data, task = build(settings, source, trains=trains)
        else:
            data, task, notes = build_trained(settings, trained, source)
        stored = {n: value for n, value in settings.items() if n not in ("choices", "trust")}
        stored = {"choices": _choices(settings, source), **named_arguments(stored)}
        write_settings(folder / "config.yaml", stored)
        return Run(folder, stored, source, data, task, trained, notes)

    def trainer(self, callbacks: Sequence[Callback]) -> lightning.Trainer:
        """Build the trainer of the config, with further callbacks."""
        # Without loggers, whose settings may hold a server's address: checkpoints are passed on.
        config = {name: value for name, value in self.settings.items() if name != "logger"}
        contents = {
            "predicts": self.task.predicts,
            "depth_kind": self.task.depth_kind,
            "config": config,
            **inputs_and_classes(self.data),
        }
        return build_trainer(
            self.settings, self.folder, self.task, contents, callbacks, self.source
        )

    def test(self, trainer: lightning.Trainer, checkpoint: Path) -> None:
        """Evaluate a checkpoint's weights on the test fold and write the results.

        Raises:
            SettingError: The data or the network do not match the weights.
        """
        if self.trained is None:
            content = read_checkpoint(checkpoint)
            check_fits(self.data, content, checkpoint)
            self._load(content["state_dict"], checkpoint)
        by_classes = self.task.predicts == PIXEL_CLASSES  # else upright=auto is by the image alone
        if getattr(self.data, "upright", None) == "auto" and by_classes:
            self.data.estimate_up(NetworkJudge(self._as_trained(), trainer.strategy.root_device))
        trainer.test(self.task, datamodule=self.data, verbose=False)
        noun, total = self.data.noun, len(self.data.dataset("test"))
        tested = sum(trainer.num_test_batches) > 0  # else `task.result` is that of a validation
        record = self.task.evaluation_result(self.task.result, noun) if tested else None
        images = record.images if record else 0
        if record and images == total:
            record = replace(record, groups=self._groups(trainer.world_size))
            self._report(record, checkpoint, trainer.callbacks)  # type: ignore[attr-defined]
            return
        if not getattr(trainer, "fast_dev_run", False) and str(trainer.limit_test_batches) == "1.0":
            raise RuntimeError(f"{images} of {total} test {noun} were counted")
        rank_zero_only(print_text)(
            f"{images} of {total} test {noun} were evaluated because of trainer.limit_test_batches "
            "or trainer.fast_dev_run: no results are written."
        )

    def _groups(self, world_size: int) -> list[dict[str, Any]]:
        """Return the scores of each group of test images, see `LabeledData.groups`."""
        items, places = self.data.splits()["test"], defaultdict(list)
        for place, index in enumerate(gathered_order(len(items), world_size)):
            for group in self.data.groups(items[index]):
                places[group].append(place)
        return [
            {"group": group, "images": len(some)}
            | plain_scores(self.task.scores_of(self.task.result, some))
            for group, some in sorted(places.items())
        ]

    def _as_trained(self) -> LoadedNetwork:
        """Return the network of the run with its inputs, classes and representation."""
        if self.trained is not None:
            return self.trained
        data = self.data
        network = ClassScoreNetwork(self.task.network, data.num_classes).eval()
        return LoadedNetwork(
            module=self.task.network,
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
    def _report(
        self, record: EvaluationResult, checkpoint: Path, callbacks: Sequence[Callback]
    ) -> None:
        is_inside = checkpoint.is_relative_to(self.folder)
        # A relative path stays right when the folder is moved.
        name = str(checkpoint.relative_to(self.folder) if is_inside else checkpoint)
        record = replace(
            record,
            protocol={**self.data.facts, **self.task.facts},
            checkpoint=name,
            label_map=self.settings.get("label_map"),
            folds=getattr(self.data, "folds", ()),
            settings=dict(flat_settings(self.settings)),
        )
        notes, tables = [f"Checkpoint: {name}", *self.notes], result_tables(record)
        summary, (rows, sources) = summary_lines(record), published_rows([record])
        published = [published_table(rows, record)] if rows else []
        write_results(record, self.folder, [*notes, *sources], published)
        write_report(
            self.folder / "report.html",
            f"Evaluation of {checkpoint.name}",
            tables=[*tables, *([confusion_table(record)] if record.confusion else [])],
            images=[i for c in callbacks if isinstance(c, PredictionPanels) for i in c.images],
            class_names=self.task.class_names,
            notes=[*summary, *notes],
        )
        for line in (*self.notes, *summary):
            print_text(line)
        tables[0].print()
        print_text(f"Results, pictures and logs: {self.folder}; report.html opens in a browser.")


def build(
    settings: Mapping[str, Any], source: SettingsFile | None = None, *, trains: bool = True
) -> tuple[Any, Any]:
    """Build the data module and the task of a run, and try them on empty inputs.

    Network settings that are null are taken from the data: ``in_channels``, and ``num_classes`` or
    ``classes``, also of a network inside the network's settings. Pretrained weights are not fetched
    if a checkpoint replaces them.

    Args:
        settings: Settings of the run.
        source: File that settings come from, see `build_from_config`.
        trains: True if the task is trained; else its optimizer and scheduler are not built.

    Returns:
        Data module and task.

    Raises:
        SettingError: A setting, or a combination of settings, is invalid.
    """
    data = build_data(settings, source)
    restored = settings.get("resume") is not None or settings.get("checkpoint") is not None
    count_outputs = getattr(resolve_target(settings["task"], "task", source), "num_outputs", int)
    outputs = count_outputs(data.num_classes)
    section = completed_settings(
        settings.get("network"), data.in_channels, outputs, restored=restored
    )
    network = build_from_config(section, "network", source)
    task = _build_task(settings, data, network, source, trains=trains)
    try_network(task, data.in_channels)
    if trains:
        try_training(task, data, settings)
    return data, task


def build_data(settings: Mapping[str, Any], source: SettingsFile | None = None) -> Any:
    """Build the data module of a run and check that it has the labels of the task; see `build`."""
    data_set = resolve_target(settings["data"], "data", source)
    if isinstance(data_set, type) and not issubclass(data_set, DataModule):
        expected = "labeled images or shapes; pairs are for tangent-keypoints"
        raise SettingError("data", found=data_set.__name__, expected=expected)
    data = open_data(settings, source)
    data.check_classes()
    task = resolve_target(settings["task"], "task", source)
    needed = getattr(task, "labels", data.labels)
    if needed != data.labels:
        raise SettingError(
            "task",
            found=f"{getattr(task, '__name__', task)}, which needs {needed}",
            expected=f"a task for {data.labels}, the labels of {type(data).__name__}",
        )
    return data


def open_data(settings: Mapping[str, Any], source: SettingsFile | None = None) -> Any:
    """Build the data of a run, unchecked; images have distances as labels if the task needs them.

    Args:
        settings: Settings of the run.
        source: File that settings come from, see `build_from_config`.
    """
    representation = build_from_config(settings["representation"], "representation", source)
    task, data_set = (resolve_target(settings[s], s, source) for s in ("task", "data"))
    is_images = isinstance(data_set, type) and issubclass(data_set, ImageDataModule)
    has_distances = is_images and getattr(task, "labels", None) == DISTANCE
    given: dict[str, Any] = {"labels": DISTANCE} if has_distances else {}
    given["representation"] = representation
    return build_from_config(settings["data"], "data", source, **given)


def build_trained(
    settings: Mapping[str, Any], trained: LoadedNetwork, source: SettingsFile | None = None
) -> tuple[Any, Any, list[str]]:
    """Build the data module and the task that evaluate a network from a file.

    Args:
        settings: Settings of the evaluation; ``label_map`` and ``unmapped`` are optional.
        trained: Network to evaluate.
        source: File that settings come from, see `build_from_config`.

    Returns:
        Data module, task, and notes on the label map.

    Raises:
        SettingError: The network does not fit the data, or the label map fits neither of them.
    """
    task = resolve_target(settings["task"], "task", source)
    remedy = "Choose the task of the network: task=segmentation for classes, task=depth for depth."
    trained.check_predicts(getattr(task, "predicts", ""), remedy)
    data = build_data(settings, source)
    notes = []
    if settings.get("label_map") is not None:
        parsed = parse_settings(LabelMapSettings, settings)
        label_map = load_label_map(parsed.label_map)
        mapped = map_classes(trained, label_map, parsed.unmapped, data.class_names[1:])
        trained, notes = mapped.trained, [f"Label map {label_map.name}: {mapped}."]
    check_fits(data, inputs_and_classes(trained), settings["checkpoint"])
    check_size(trained, data.representation.image_size)
    task = _build_task(settings, data, trained.network, source, trains=False)
    return data, task, notes


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


def _build_task(
    settings: Mapping[str, Any],
    data: Any,
    network: nn.Module,
    source: SettingsFile | None,
    *,
    trains: bool,
) -> Any:
    parts: dict[str, Any] = {"optimizer": None}
    if trains:
        parts["optimizer"] = build_from_config(settings["optimizer"], "optimizer", source)
    if trains and settings.get("scheduler") is not None:
        section = dict(settings["scheduler"])
        timing = {n: section.pop(n) for n in ("interval", "frequency", "monitor") if n in section}
        scheduler = build_from_config(section, "scheduler", source)
        parts["scheduler"] = Schedule(scheduler, **timing)
    return build_from_config(
        settings["task"],
        "task",
        source,
        network=network,
        representation=data.representation,
        class_names=data.class_names,
        **parts,
    )


def _choices(settings: Mapping[str, Any], source: SettingsFile | None) -> dict[str, str]:
    """Return the chosen options of config groups, except where a file replaced the section."""
    chosen, stored = HydraConfig.get().runtime.choices, settings.get("choices") or ()
    return {
        group: chosen[group]
        for group in GROUPS
        if chosen.get(group)
        and (source is None or group in stored or group == "experiment" or not source.gave(group))
    }


@contextmanager
def machine_faults(folder: Path, data: Any) -> Iterator[None]:
    """Explain a full disk, and data workers that died.

    Args:
        folder: Run folder.
        data: Data module of the run.

    Raises:
        NoRoomError: The disk is full while a file is written that is not written atomically, such
            as TensorBoard's events.
        DataError: A worker died.
    """
    try:
        yield
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        explanation = no_room(folder, error) or explained(error, data.num_workers)
        if explanation is error:
            raise
        raise explanation from error
