"""``tangent-transfer``: train on photos, evaluate on panoramas, fine-tune on either, compare."""

from __future__ import annotations

import re
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict
from rich.console import Console

from tangent_train.cli.compose import compose_option
from tangent_train.cli.transfer.given import check_given
from tangent_train.cli.transfer.stage_runs import run_stage, said_as_a_command, stage_state
from tangent_train.cli.transfer.stages import Stage, folds_and_seeds, plan, stage_folder
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

__all__ = ["transfer"]

_FOLD_AND_SEED = re.compile(r"(?:fold_(\d+)/)?seed_(\d+)")


def transfer(config: DictConfig) -> None:
    """Run all stages that are not finished, then write and print the tables.

    Args:
        config: The composed ``transfer.yaml``.

    Raises:
        SettingError: A setting cannot work, or a stage's folder holds something else.
        DataError: The given checkpoint, or a file of a stage, cannot be used.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    _check_typed(config)
    _leave_out_foreign(config)
    asked = folds_and_seeds(config)
    if config.checkpoint is not None:
        config.checkpoint = str(Path(config.checkpoint).absolute())
        check_given(config, [fold for fold, _ in asked])
    compared = _compared(config)
    stages = [stage for fold, seed in asked for stage in plan(config, folder, fold, seed, compared)]
    missing = [stage for stage in stages if stage_state(stage) != "finished"]
    _try([stage for stage in missing if (stage.fold, stage.seed) == asked[0]])
    try:
        for number, stage in enumerate(stages, start=1):
            _run(stage, f"Stage {number} of {len(stages)}")
    except (KeyboardInterrupt, SystemExit):
        _say("Finished stages stay; the same command goes on.", error=True)
        raise
    from tangent_train.cli.transfer.report import write_report  # heavy, and last

    others, remarks = _finished_elsewhere(config, folder, asked, compared)
    for text in (*write_report(config, folder, [*stages, *others]), *remarks):
        _say(text)


def _try(stages: Sequence[Stage]) -> None:
    """Build what stages are made of: what cannot work is said before hours of training."""
    from tangent_train.cli.run import build

    built: list[tuple[Stage, Any]] = []
    tried: list[tuple[Any, ...]] = []
    network: dict[str, Any] = {}
    for stage in stages:
        parts = stage.config["data"], stage.config["representation"], stage.config["level"]
        if parts not in tried:
            tried.append(parts)
            config: Any = OmegaConf.to_container(OmegaConf.create(stage.config), resolve=True)
            config["checkpoint"] = "P's: no weights are fetched"
            with _named(stage):
                built.append((stage, build(config)[0]))
                _check_alike(network, built[-1][1])
    for stage, data in built:  # after all settings: this makes files
        with _named(stage):
            data.make_files()
            data.setup()


@contextmanager
def _named(stage: Stage) -> Iterator[None]:
    """Say which stage an error is about: settings of the photos are below ``photos``."""
    try:
        yield
    except (DataError, SettingError) as error:
        where = ", in photos" if stage.on == "photos" else ""
        raise SettingError(f"stage {stage.name}{where}: {error}") from error


def _check_alike(network: dict[str, Any], data: Any) -> None:
    """Refuse data that means something else to the network than that of earlier stages."""
    own = {
        "class_names": data.class_names,
        "inputs": data.inputs,
        "normalization": data.normalization,
    }
    for name, value in own.items():
        before = network.setdefault(name, value)
        if before != value:
            raise SettingError(
                f"data.{name}",
                found=value,
                expected=f"{before}, as in the stages before",
                remedy="One network sees photos and panoramas: choose data and data@photos.data "
                "of one kind, with the same inputs.",
            )


def _check_typed(config: DictConfig) -> None:
    """Refuse a single fold or seed beside a list of them, which would go unheard."""
    typed = HydraConfig.get().overrides.task
    for single, several in (("data.fold", "folds"), ("seed", "seeds")):
        said = next((text for text in typed if text.startswith(f"{single}=")), None)
        if said is not None and config[several] is not None:
            number = said.partition("=")[2]
            raise SettingError(
                said,
                found=f"{several}={list(config[several])} beside it",
                expected=f"{several}=[{number}], or {several}=null",
            )
    for text in typed:
        if text.startswith("photos.data.fold="):
            raise SettingError(text, found="a fold of the photos", expected="data.fold, of both")


def _leave_out_foreign(config: DictConfig) -> None:
    """Leave out what an experiment sets of its representation when the command chose another.

    Tangent images have a base level, equirectangular images do not know what that is.
    """
    typed = HydraConfig.get().overrides.task
    chosen = next((t.partition("=")[2] for t in typed if t.startswith("representation=")), None)
    if chosen is None:
        return
    known = compose_option("representation", chosen, _search_path()).keys()
    said = {text.lstrip("+~").partition("=")[0] for text in typed}
    with open_dict(config):
        for name in list(config.representation):
            if name not in known and f"representation.{name}" not in said:
                del config.representation[name]


def _run(stage: Stage, number: str) -> None:
    state = stage_state(stage)
    what = f"{number}, {stage.name} in {stage.folder}"
    if state == "finished":
        _say(f"{what}: finished before.")
        return
    _say(f"{what}: {said_as_a_command(stage, state)}")
    status = run_stage(stage, state)
    if status:
        _say(
            f"tangent-transfer: stage {stage.name} in {stage.folder} ended with status {status}.",
            error=True,
        )
        sys.exit(status)


def _compared(config: DictConfig) -> dict[str, dict[str, Any]]:
    """The further ways to see panoramas, without the transfer's own."""
    own = HydraConfig.get().runtime.choices.get("representation")
    names = config.compare or ()
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise SettingError(
            "compare", found=names, expected="a list of options of representation, or []"
        )
    found = {
        name: compose_option("representation", name, _search_path())
        for name in dict.fromkeys(names)
        if name != own
    }
    equirect = [n for n, s in found.items() if s["_target_"].endswith("EquirectRepresentation")]
    if equirect and "SphereContext" in str(config.network):
        raise SettingError(
            "compare",
            found=equirect[0],
            expected="no equirectangular images for a network whose images see each other",
            remedy="For example compare=[cubemap].",
        )
    return found


def _search_path() -> list[str]:
    hydra = HydraConfig.get().overrides.hydra
    return [text for text in hydra if text.startswith("hydra.searchpath")]


def _finished_elsewhere(
    config: DictConfig,
    folder: Path,
    asked: Sequence[tuple[int | None, int]],
    compared: Mapping[str, Mapping[str, Any]],
) -> tuple[list[Stage], list[str]]:
    """Finished stages of folds and seeds that earlier commands asked for, and remarks."""
    found, remarks = [], []
    if config.checkpoint is not None:  # theirs would be other networks
        return [], []
    for path in sorted([*folder.glob("seed_*"), *folder.glob("fold_*/seed_*")]):
        match = _FOLD_AND_SEED.fullmatch(path.relative_to(folder).as_posix())
        if match is None or path in {stage_folder(folder, *pair) for pair in asked}:
            continue
        fold, seed = (None if part is None else int(part) for part in match.groups())
        for stage in plan(config, folder, fold, int(seed or 0), compared):
            try:
                if stage_state(stage) == "finished":
                    found.append(stage)
            except (SettingError, DataError):
                remarks.append(f"{stage.folder}: of other settings, not in the tables.")
                if stage.name == "P":  # all others go back to it
                    break
    return found, remarks


def _say(text: str, *, error: bool = False) -> None:
    Console(stderr=error, soft_wrap=True, highlight=False).print(text, markup=False)
