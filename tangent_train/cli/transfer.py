"""``tangent-transfer``: train on photos, evaluate on panoramas, fine-tune on both, compare.

Its stages are runs of ``tangent-train`` and ``tangent-evaluate`` (paper, "Network transfer"):

===========  ===============================================================================
P            trained on photos, tested on photos
S            P, tested on panoramas
S-<view>     P, tested on panoramas through another view
S-…-<name>   the same in another condition, e.g. tilted
P-FT-n       P, fine-tuned for n epochs on photos, tested on photos
S-FT-n       P, fine-tuned for n epochs on panoramas, tested on panoramas
S-level-n    P, tested on panoramas of level n (study of the angular resolution)
===========  ===============================================================================

The folder of the transfer has a manifest of finished stages, and the settings of each stage as a
config of its command in ``stages/``.
"""

from __future__ import annotations

import itertools
import shlex
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.checkpoints.outputs import network_for_views
from tangent_train.cli import main
from tangent_train.cli.processes import command_line, run_process
from tangent_train.cli.run import build_data
from tangent_train.config.settings import SETTINGS, typed_names, typed_settings, validate
from tangent_train.console import print_text
from tangent_train.errors import SettingError
from tangent_train.files import quoted, write_text
from tangent_train.inference.engine import views_per_forward
from tangent_train.inference.views import PERSPECTIVE, panorama_settings
from tangent_train.manifest import Manifest
from tangent_train.results.evaluation import load_result
from tangent_train.results.report import levels_report, transfer_report

_HEAD = {"defaults": ["_self_", {"override hydra/job_logging": "none"}]}
_SLOWER = 10  # in fine-tuning: from 1e-4 to 1e-5 (paper, supplement, "Transfer learning")
_NOT_CONTENT = (
    "seeds", "folds", "compare", "conditions", "study_levels", "panels", "logger",
    "validation_images", "checkpoint_every_n_steps",
)  # fmt: skip
"""Settings that may differ when a transfer is continued: they add stages, or only show them."""


@dataclass(frozen=True)
class Stage:
    """One run of a transfer.

    Attributes:
        name: Name of the stage, see the table above.
        command: Command that runs the stage.
        changes: Settings in which the stage differs from the transfer.
        view: Name of the view that panoramas are evaluated in; "" for the view of the transfer.
        condition: Condition that panoramas are evaluated in; "" in other stages.
        path: Run folder, below that of the transfer.
    """

    name: str
    command: str
    changes: Mapping[str, Any]
    view: str = ""
    condition: str = ""
    path: Path = Path()


def transfer(_: object) -> None:
    """Run all stages that are not finished, then write and print the tables.

    Raises:
        SettingError: A setting is invalid, or the transfer was begun with other settings.
    """
    # Composed again, because the stages need the settings with their references.
    config: Any = compose("transfer", [*_search_path(), *typed_settings()])
    folder, loaded = Path(HydraConfig.get().runtime.output_dir), None
    if config.checkpoint is not None:
        loaded = load_network(Path(config.checkpoint), config.trust)
        _take_settings(config, loaded)
    content: Any = OmegaConf.to_container(config)
    content["fine_tuning"].pop("epochs")
    folds, seeds = config.folds or [config.data.get("fold")], config.seeds or [config.seed]
    groups, plan = itertools.product(folds, seeds), list(_plan(config, loaded))
    stages = [_of_group(config, stage, *group) for group in groups for stage in plan]
    manifest = Manifest.open(folder, {n: v for n, v in content.items() if n not in _NOT_CONTENT})
    settings = {str(stage.path): stage_settings(config, folder, stage) for stage in stages}
    _check_data([settings[name] for name in manifest.missing(settings)])
    manifest.finish("checks")  # an interrupted stage is resumed: other settings are refused
    for number, stage in enumerate(stages, start=1):
        heading = f"Stage {number} of {len(stages)}, {stage.name} in {folder / stage.path}"
        _run(stage, settings[str(stage.path)], manifest, heading)
    _report(config, folder, stages)


def _search_path() -> list[str]:
    return [o for o in HydraConfig.get().overrides.hydra if o.startswith("hydra.searchpath")]


def _take_settings(config: Any, loaded: LoadedNetwork) -> None:
    """Set inputs and level to those of a network from a file, and the views of an imported one."""
    typed = typed_names()
    config.checkpoint = str(Path(config.checkpoint).absolute())
    config.level = config.level if "level" in typed else loaded.level
    if _has_panorama_views(loaded) and "representation" not in typed:
        views = panorama_settings(loaded, config.level if "level" in typed else None)
        rows = config.representation.get("erp_height")
        config.representation = views | ({} if rows is None else {"erp_height": rows})
    config.data = {**config.data, **loaded.data_settings}
    if "task.eval_view_batch_size" not in typed:  # photo networks have many classes, large images
        config.task.eval_view_batch_size = views_per_forward(loaded.image_size)


def _has_panorama_views(loaded: LoadedNetwork | None) -> bool:
    """Return True for a network from a file that names views of panoramas."""
    return loaded is not None and loaded.representation["_target_"] != PERSPECTIVE


def _plan(config: Any, loaded: LoadedNetwork | None) -> Iterator[Stage]:
    """Yield the stages of one fold and seed."""
    has_photos, study = "_target_" in config.photos.data, config.study_levels
    if loaded is None and not has_photos:
        expected = "the photos to train P on, or checkpoint=<a network trained on photos>"
        raise SettingError("data@photos.data", found="none", expected=expected)
    if has_photos and not (study and loaded):
        yield Stage("P", "evaluate" if loaded else "train", {})
    views = _levels(config, loaded) if study else {"": {}, **_views(config, loaded)}
    for view, of_view in views.items():
        for condition, changes in _named(config.conditions):
            of_data = {f"data.{name}": value for name, value in changes.items()}
            name = "-".join(filter(None, ("S", view, condition if of_data else "")))
            yield Stage(name, "evaluate", {**of_view, **of_data}, view, condition)
    for epochs in () if study else config.fine_tuning.epochs:
        for name in "PS":
            yield Stage(f"{name}-FT-{epochs}", "train", _fine_tuning(config, epochs))


def _of_group(config: Any, stage: Stage, fold: int | None, seed: int) -> Stage:
    """Return a stage for a fold and a seed."""
    changes, path = {**stage.changes, "seed": seed}, Path(f"seed_{seed}", stage.name)
    if fold is not None:
        changes["data.fold"], path = fold, f"fold_{fold}" / path
        if "fold" in config.photos.data:
            changes["photos.data.fold"] = fold
    return replace(stage, changes=changes, path=path)


def stage_settings(config: Any, folder: Path, stage: Stage) -> dict[str, Any]:
    """Return the settings of a stage, resolved after its changes."""
    config = OmegaConf.create(OmegaConf.to_container(config))
    for key, value in stage.changes.items():
        OmegaConf.update(config, key, value, merge=False, force_add=True)
    settings: Any = OmegaConf.to_container(config, resolve=True)
    trained = folder / stage.path.parent / "P" / "checkpoints" / "best.ckpt"
    weights = settings.pop("checkpoint") or (None if stage.name == "P" else str(trained))
    settings["init_from" if stage.command == "train" else "checkpoint"] = weights
    settings["name"] = f"{settings['name']}/{stage.name}"
    if stage.name[0] == "P":
        settings |= {key: settings["photos"][key] for key in ("data", "representation")}
    if stage.command == "evaluate" and config.checkpoint:
        settings["network"] = None  # in the checkpoint
    declared = SETTINGS[stage.command].model_fields
    return {key: value for key, value in settings.items() if key in declared}


def _fine_tuning(config: Any, epochs: int) -> dict[str, Any]:
    """Return the changes of settings in fine-tuning."""
    tuning: Any = OmegaConf.to_container(config.fine_tuning)
    before: Any = OmegaConf.to_container(config.optimizer)
    optimizer = before | tuning["optimizer"]
    if optimizer["lr"] is None:  # rounded: 3e-3 / 10 is 3.0000000000000003e-4
        optimizer["lr"] = float(f"{config.optimizer.lr / _SLOWER:.12g}")
    return {
        "optimizer": optimizer,
        "scheduler": tuning["scheduler"],
        "trainer.max_epochs": epochs,
        "photos.data.sampling_seed": 1,  # not the crops of P's first epochs again
    }


def _named(entries: Sequence[Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the entries of a list, names or named settings, as settings by name."""
    for entry in entries:
        named = isinstance(entry, str)
        settings: Any = {"name": entry} if named else OmegaConf.to_container(entry)
        yield settings.pop("name"), settings


def _levels(config: Any, loaded: LoadedNetwork | None) -> dict[str, dict[str, Any]]:
    """Return the views of the study of the resolution, as changes of settings by name."""
    rows = {level: min(2 ** (level + 1), config.study_max_rows) for level in config.study_levels}
    return {f"level-{n}": _view(config, loaded, level=n, erp_height=rows[n]) for n in rows}


def _views(config: Any, loaded: LoadedNetwork | None) -> dict[str, dict[str, Any]]:
    """Return the views of ``compare`` as changes of settings by name.

    A view is an option of ``representation`` (a name alone, or ``option``) with changed settings;
    without an option, it is the transfer's own representation with changed settings. ``level`` also
    sets the level of the stage; names such as ``task.head.align`` change the task. Distortion-aware
    views of a network that does not allow them are left out.
    """
    views = {}
    for name, changes in _named(config.compare):
        view = _view(config, loaded, **(changes or {"option": name}))
        try:
            if loaded is not None:
                is_aware = view["representation"].get("distortion_aware")
                network_for_views(loaded.network, is_aware)
            views[name] = view
        except SettingError as error:
            print_text(f"View {name} is left out: {error}")
    return views


def _view(config: Any, loaded: Any, option: str | None = None, **changes: Any) -> dict[str, Any]:
    """Return a view as changes of settings, see `_views`."""
    of_task = {name: changes.pop(name) for name in [*changes] if name.startswith("task.")}
    level, rows = changes.get("level"), config.representation.get("erp_height")
    section: Any = OmegaConf.to_container(config.representation)
    if option is not None:
        chosen = compose(f"representation/{option}", _search_path())
        section = OmegaConf.to_container(chosen.representation)
    elif _has_panorama_views(loaded) and {"level", "base_level"} & changes.keys():
        of_level = panorama_settings(loaded, level, changes.get("base_level"))
        section = (section if section["_target_"] == of_level["_target_"] else {}) | of_level
    elif level is not None and section.get("dim") is not None:  # a side in pixels
        section["dim"] = max(1, round(section["dim"] * 2.0 ** (level - config.level)))
    if rows is None and level is not None:
        rows = 2 ** (config.level + 1)
    section |= ({} if rows is None else {"erp_height": rows}) | changes
    return {"representation": section, **of_task} | ({} if level is None else {"level": level})


def _check_data(stages: Sequence[Mapping[str, Any]]) -> None:
    """Build the data of the photos and of the panoramas, before hours of training."""
    classes = {}
    for target, settings in {stage["data"]["_target_"]: stage for stage in stages}.items():
        of_run = {
            name: settings[name] for name in SETTINGS["check"].model_fields if name in settings
        }
        data = build_data(validate("check", of_run))
        data.make_files()
        data.setup()
        classes[target] = tuple(data.class_names)
    if len({*classes.values()}) > 1:
        raise SettingError(
            "data", found=f"classes {classes}", expected="the same of both data sets"
        )


def _run(stage: Stage, settings: Mapping[str, Any], manifest: Manifest, heading: str) -> None:
    """Run a stage that is not finished, printing its command after a heading."""
    run, before = manifest.folder / stage.path, manifest.finished.get(str(stage.path))
    if before is not None and (run / "results.json").is_file():
        if before["changes"] != stage.changes:
            raise SettingError(stage.name, found=stage.changes, expected=before["changes"])
        print_text(f"{heading}: finished before.")
        return
    arguments = [f"resume={quoted(run)}"]
    if not (run / "checkpoints" / "last.ckpt").is_file():
        shutil.rmtree(run, ignore_errors=True)
        file = manifest.folder / "stages" / f"{'-'.join(stage.path.parts)}.yaml"
        write_text(file, OmegaConf.to_yaml(OmegaConf.create({**_HEAD, **settings})))
        arguments = [f"--config-dir={file.parent}", f"--config-name={file.stem}"]
    line = command_line(stage.command, arguments, run)
    print_text(f"{heading}: tangent-{stage.command} {shlex.join(line[1:])}")
    if status := run_process(line):
        message = f"Stage {stage.name} ended with status {status}; the same command continues."
        print_text(message, error=True)
        sys.exit(status if status > 0 else 128 - status)
    manifest.finish(str(stage.path), changes=stage.changes)


def _report(config: Any, folder: Path, stages: Sequence[Stage]) -> None:
    """Write and print the tables and the chart."""
    results: dict[Any, list[Any]] = defaultdict(list)
    for stage in stages:
        key = stage.changes["level"] if config.study_levels and stage.view else stage.name
        results[key].append(load_result(folder / stage.path))
    if config.study_levels:
        results.pop("P", None)
        name, report = "angular_resolution", levels_report(results, config.level)
    else:
        cells = {s.name: (s.view or "S", s.condition) for s in stages if s.condition}
        name, report = "transfer", transfer_report(results, cells)
    report.write(folder, name)
    report.print()
    print_text(f"Tables and a chart: {folder / name}.md, .csv, .png")


if __name__ == "__main__":
    main.transfer()
