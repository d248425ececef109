"""``tangent-transfer``: train on photos, evaluate on panoramas, fine-tune on either, compare."""

from __future__ import annotations

import math
import shlex
import sys
from collections import defaultdict
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from rich.console import Console

from tangent_train.cli.compose import compose_option
from tangent_train.cli.transfer_stages import (
    STUDY,
    Stage,
    plan,
    run_stage,
    stage_command,
    stage_state,
)
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from omegaconf import DictConfig

__all__ = ["trained_level", "transfer"]

_MOST_SHOWN = 3


def transfer(config: DictConfig) -> None:
    """Run all stages that are not finished, then write and print the tables.

    Args:
        config: The composed ``transfer.yaml``.

    Raises:
        SettingError: A setting is invalid, or a stage's folder holds something else.
        DataError: The given checkpoint, or a file of a stage, cannot be used.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    _check_typed(config)
    if config.checkpoint is not None:
        config.checkpoint = str(Path(config.checkpoint).absolute())
    stages = plan(config, folder, _compared(config))
    _check_given(config, stages)
    missing = [stage for stage in stages if stage_state(stage) != "finished"]
    first = stages[0].fold, stages[0].seed
    _check_data([stage for stage in missing if (stage.fold, stage.seed) == first])
    try:
        for number, stage in enumerate(stages, start=1):
            _run(stage, f"Stage {number} of {len(stages)}, {stage.name} in {stage.folder}")
    except (KeyboardInterrupt, SystemExit):
        _say("Finished stages are kept; the same command continues.", error=True)
        raise
    _report(config, folder, stages)


def _check_typed(config: DictConfig) -> None:
    """Refuse a single fold or seed beside a list of them, which would be ignored."""
    for text in HydraConfig.get().overrides.task:
        name, _, number = text.partition("=")
        several = {"data.fold": "folds", "seed": "seeds"}.get(name)
        if several is not None and config[several] is not None:
            raise SettingError(
                text,
                found=f"{several}={list(config[several])} beside it",
                expected=f"{several}=[{number}], or {several}=null",
            )


def _compared(config: DictConfig) -> dict[str, dict[str, Any]]:
    """The further representations of the panoramas, without the transfer's own."""
    hydra = HydraConfig.get()
    names = config.compare or ()
    if isinstance(names, str):
        raise SettingError(
            "compare", found=names, expected="a list of options of representation, or []"
        )
    search = [text for text in hydra.overrides.hydra if text.startswith("hydra.searchpath")]
    own = hydra.runtime.choices.get("representation")
    return {name: compose_option("representation", name, search) for name in names if name != own}


def _check_given(config: DictConfig, stages: Sequence[Stage]) -> None:
    """Refuse a checkpoint that has seen the test rooms of another fold."""
    from tangent_train.checkpoints.content import read_checkpoint
    from tangent_train.registry import check_fields

    if config.checkpoint is None:
        return
    path, expected = Path(config.checkpoint), "the settings of a run"
    given = read_checkpoint(path, ("config",))["config"]
    data = check_fields(path, given, {"data": dict}, expected)["data"]
    fold = check_fields(path, data, {"fold": int | None}, expected, "data")["fold"]
    if fold is not None and {stage.fold for stage in stages} != {fold}:
        raise SettingError(
            f"checkpoint={config.checkpoint}",
            found=f"a network for testing on fold {fold}, of the others it has seen the rooms",
            expected=f"folds=[{fold}]",
        )


def _check_data(stages: Sequence[Stage]) -> None:
    """Build the data and networks of all stages: errors come before hours of training."""
    from tangent_train.cli.build import build

    built: list[tuple[Stage, Any]] = []
    tried: list[Any] = []
    for stage in stages:
        parts = [stage.config[name] for name in ("data", "representation", "level")]
        if parts in tried:
            continue
        tried.append(parts)
        with _named(stage):
            # No weights are fetched for a network that a checkpoint restores.
            built.append((stage, build({**stage.config, "checkpoint": "P"})[0]))
            _check_alike(built[0][1], built[-1][1])
    for stage, data in built:  # after all settings: this makes files
        with _named(stage):
            data.make_files()
            data.setup()
    _tell_shared_scenes(built)


def _check_alike(first: Any, own: Any) -> None:
    """Refuse data that a network of the first stage cannot take, or would take for another."""
    for number, (before, now) in enumerate(zip_longest(first.class_names, own.class_names)):
        if before != now:
            raise SettingError(
                "data",
                found=f"{now or 'nothing'} as class {number} in {own.classes_from}",
                expected=f"{before or 'nothing'}, as in {first.classes_from}",
                remedy="Photos and panoramas have the same classes in the same order.",
            )
    for name in ("inputs", "normalization"):
        before, now = getattr(first, name), getattr(own, name)
        if before != now:
            raise SettingError(
                f"data.{name}", found=now, expected=f"{before}, as in the stages before"
            )


def _tell_shared_scenes(built: Sequence[tuple[Stage, Any]]) -> None:
    """Say which scenes P is trained on and S tested: only their names are known to be the same."""
    trained, tested = (
        {
            item.name.partition("/")[0]
            for stage, data in built
            if stage.name[0] == kind
            for item in data.found().of(splits)
        }
        for kind, splits in (("P", ("train", "val")), ("S", ("test",)))
    )
    shared = sorted(trained & tested)
    if shared:
        more = f" and {len(shared) - _MOST_SHOWN} others" if len(shared) > _MOST_SHOWN else ""
        _say(
            f"Note: P is trained on photos, and S tested on panoramas, of "
            f"{', '.join(shared[:_MOST_SHOWN])}{more}. If they show the same places, hold them out "
            "of both, for example in test.txt."
        )


@contextmanager
def _named(stage: Stage) -> Iterator[None]:
    """Name the stage of an error: settings of the photos are under ``photos``."""
    try:
        yield
    except (DataError, SettingError) as error:
        where = ", in photos" if stage.name[0] == "P" else ""
        raise SettingError(f"stage {stage.name}{where}: {error}") from error


def _run(stage: Stage, what: str) -> None:
    state = stage_state(stage)
    if state == "finished":
        _say(f"{what}: finished before.")
        return
    _, _, _, command, *arguments = stage_command(stage)
    _say(f"{what}: tangent-{command} {shlex.join(arguments)}")
    status = run_stage(stage, state)
    if status:
        name = f"stage {stage.name} in {stage.folder}"
        _say(f"tangent-transfer: {name} ended with status {status}.", error=True)
        sys.exit(status)


def _report(config: DictConfig, folder: Path, stages: Sequence[Stage]) -> None:
    """Write and print the tables and the chart."""
    from tangent_train.results.comparisons import levels_report, transfer_report
    from tangent_train.results.record import load_record

    found: dict[Any, list[Any]] = defaultdict(list)
    for stage in stages:
        if not config.study or stage.level is not None:
            found[stage.level if config.study else stage.name].append(load_record(stage.folder))
    if config.study:
        name, report = STUDY, levels_report(found, trained_level(config))
    else:
        name, report = "transfer", transfer_report(found)
    report.write(folder, name)
    Console(highlight=False).print(report.tables()[0].terminal())
    for note in report.all_notes():
        _say(f"- {note}")
    _say(f"Tables and a chart: {folder / name}.md, .csv, .json, .png")


def trained_level(config: DictConfig) -> float:
    """The level at which the panoramas' images have the focal length of the photos' crops.

    That of a crop is ``f' = W' / (2 tan(Ω'/2))`` pixels (paper, supplement, "Camera
    normalization"), that of a tangent image 1/p: every level doubles it. The paper's 45° and 128
    pixels for level 8 are as fine as level 8.42 at b = 1.

    Args:
        config: The composed ``transfer.yaml``.
    """
    from tangent_train.geometry import camera_matrix_from_fov
    from tangent_train.registry import make

    settings: Any = OmegaConf.to_container(config, resolve=True)
    photos = make(settings["photos"]["representation"], "photos.representation")
    panoramas = make(settings["representation"], "representation")
    focal = camera_matrix_from_fov(photos.fov_deg, photos.image_size)[0, 0]
    grid = getattr(panoramas, "grid", None)
    pitch = math.pi / panoramas.erp_height if grid is None else grid.pitch
    return float(config.level + math.log2(focal * pitch))


def _say(text: str, *, error: bool = False) -> None:
    Console(stderr=error, soft_wrap=True, highlight=False).print(text, markup=False)
