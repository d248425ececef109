"""``tangent-transfer``: train on photos, evaluate on panoramas, fine-tune on both, compare."""

from __future__ import annotations

import re
import shlex
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.cli.stored import StoredNetwork, run_settings
from tangent_train.cli.transfer_stages import Stage, plan, run_stage, stage_command, stage_state
from tangent_train.cli.transfer_views import views_of
from tangent_train.config.build import check_fields, without_interpolation
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.imports import elsewhere

_ONLY_FOR_TRAINING = ("ema", "fine_tuning", "network", "optimizer", "scheduler")


def transfer(config: DictConfig) -> None:
    """Run all stages that are not finished, then write and print the tables.

    Args:
        config: Composed ``transfer.yaml``.

    Raises:
        SettingError: A setting is invalid, or a stage's folder has other content.
        DataError: The checkpoint of the settings, or a file of a stage, cannot be used.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    stored = trained = None
    if config.checkpoint is not None:
        config.checkpoint = without_interpolation(str(Path(config.checkpoint).absolute()))
        stored = run_settings(Path(config.checkpoint))
        if stored is None:
            config, trained = _with_network(config)
    stages = plan(config, folder, views_of(config, trained))
    if stored is not None:
        _check_fold(Path(config.checkpoint), stored, stages)
    missing = [stage for stage in stages if stage_state(stage) != "finished"]
    first = stages[0].fold, stages[0].seed
    _check_data([stage for stage in missing if (stage.fold, stage.seed) == first], trained)
    try:
        for number, stage in enumerate(stages, start=1):
            _run(stage, f"Stage {number} of {len(stages)}, {stage.name} in {stage.folder}")
    except (KeyboardInterrupt, SystemExit):
        print_text("Finished stages are kept; the same command continues.", error=True)
        raise
    _report(config, folder, stages, trained)


def _with_network(config: DictConfig) -> tuple[DictConfig, LoadedNetwork]:
    """Load a network without settings of a run; return the config for its evaluation, and it."""
    overrides = list(HydraConfig.get().overrides.task)
    for text in overrides:
        name = text.lstrip("+~").partition("=")[0]
        if re.split("[.@]", name)[0] in _ONLY_FOR_TRAINING:
            raise SettingError(
                text,
                found=f"a setting of training with checkpoint={config.checkpoint}",
                expected="none: a network without settings of a run is only evaluated",
                remedy="Fine-tune it with tangent-train init_from=….",
            )
    plain: Any = OmegaConf.to_container(config)
    settings, _, trained = StoredNetwork(Path(config.checkpoint), overrides).settings(plain)
    if "${" in str(trained.representation):
        raise DataError(
            Path(config.checkpoint),
            found=f"representation={trained.representation}",
            expected="no ${…}: settings of the stages are interpolated",
        )
    rows = config.representation.get("erp_height")
    if rows is not None:  # of all views
        settings["representation"] |= {"erp_height": rows}
    settings["network"] = None  # stages load it from its file
    settings["fine_tuning"] |= {"epochs": []}
    return OmegaConf.create(settings), trained


def _check_fold(path: Path, stored: Mapping[str, Any], stages: Sequence[Stage]) -> None:
    """Refuse a checkpoint that was trained on test rooms of the stages."""
    data = check_fields(path, stored, {"data": dict}, "the settings of a run")["data"]
    fold = data.get("fold")
    if fold is not None and any(stage.fold != fold for stage in stages):
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network that was trained on all folds but fold {fold}",
            expected=f"folds=[{fold}]",
        )


def _check_data(stages: Sequence[Stage], trained: LoadedNetwork | None) -> None:
    """Build the data and networks of all stages, to find errors before hours of training."""
    from tangent_train.cli.run import build, build_trained, check_fits, inputs_and_classes

    first: Any = None
    built: dict[Any, tuple[Stage, Any]] = {}
    tried: list[Any] = []
    for stage in stages:
        names = ["data", "representation", "level", "task"]
        names += ["optimizer", "scheduler"] if stage.command == "train" else []
        parts = [stage.config.get(name) for name in names]
        if parts in tried:
            continue
        tried.append(parts)
        with _naming_stage(stage):
            # With a checkpoint, no pretrained weights are fetched.
            settings = {**stage.config, "checkpoint": str(stage.weights)}
            data = (build_trained(settings, trained) if trained else build(settings))[0]
            first = first or data
            check_fits(data, inputs_and_classes(first), f"the network of stage {stages[0].name}")
            # Rotations, and views of the same number of rows, have the same files.
            built.setdefault((stage.name[0], getattr(data, "erp_height", 0)), (stage, data))
    for stage, data in built.values():  # after all settings are checked: this writes files
        with _naming_stage(stage):
            data.make_files()
            data.setup()
            data.test_dataloader()  # refuses an empty split: every stage is tested


@contextmanager
def _naming_stage(stage: Stage) -> Iterator[None]:
    """Name the stage in an error; settings of the photos are in the section ``photos``."""
    try:
        yield
    except (DataError, SettingError) as error:
        is_photos = stage.name[0] == "P" and re.match(r"(data|representation)\b", str(error))
        section = "photos." if is_photos and isinstance(error, SettingError) else ""
        raise SettingError(f"stage {stage.name}: {section}{error}") from error


def _run(stage: Stage, heading: str) -> None:
    """Run a stage that is not finished, printing its command after a heading."""
    state = stage_state(stage)
    if state == "finished":
        print_text(f"{heading}: finished before.")
        return
    _, _, _, command, *arguments = stage_command(stage)
    print_text(f"{heading}: tangent-{command} {shlex.join(arguments)}")
    status = run_stage(stage, state)
    if status:
        name = f"stage {stage.name} in {stage.folder}"
        print_text(f"tangent-transfer: {name} ended with status {status}.", error=True)
        sys.exit(status)


def _report(
    config: DictConfig, folder: Path, stages: Sequence[Stage], trained: LoadedNetwork | None
) -> None:
    """Write and print the tables and the chart."""
    with elsewhere():  # imports matplotlib
        from tangent_train.results.report import levels_report, transfer_report
    from tangent_train.results.evaluation_result import load_result

    records: dict[Any, list[Any]] = defaultdict(list)
    study = bool(config.study_levels)
    for stage in stages:
        if not study or stage.view:
            key = stage.config["level"] if study else stage.name
            records[key].append(load_result(stage.folder))
    if study:
        level = config.level if trained is None else trained.level
        name, report = "angular_resolution", levels_report(records, level)
    else:
        cells = {s.name: (s.view or "S", s.condition) for s in stages if s.condition}
        name, report = "transfer", transfer_report(records, cells)
    report.write(folder, name)
    report.tables()[0].print()
    for note in report.notes:
        print_text(f"- {note}")
    print_text(f"Tables and a chart: {folder / name}.md, .csv, .png")
