"""Plan the stages of a transfer (paper, section "Network transfer") and run them as ordinary runs.

===========  ===============================================================================
P            trained on photos, tested on photos
S            P, tested on panoramas
S-<view>     P, tested on panoramas through another view
S-…-<name>   the same in another condition, e.g. tilted
P-FT-n       P, fine-tuned for n epochs on photos, tested on photos
S-FT-n       P, fine-tuned for n epochs on panoramas, tested on panoramas
S-level-n    P, tested on panoramas of level n (study of the angular resolution)
===========  ===============================================================================

Besides the files of a run, a stage's folder contains ``stage.yaml``, its config for
``tangent-train`` or ``tangent-evaluate``, and ``stage.digest``, a digest of the checkpoint that it
starts from and of its label map.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from tangent_train.checkpoints.content import read_settings
from tangent_train.cli.processes import command_line, run_process
from tangent_train.cli.setting_names import declared_settings
from tangent_train.cli.transfer_views import conditions_of, numbers
from tangent_train.config.build import without_interpolation
from tangent_train.config.setting_rules import differing_settings
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_text

State = Literal["new", "begun", "finished"]
"""Progress of a stage. A stage that only evaluates is either new or finished."""

_HEAD = {"defaults": ["_self_", {"override hydra/job_logging": "none"}]}
_SLOWER = 10  # in fine-tuning: from 1e-4 to 1e-5 (paper, supplement, "Transfer learning")
_REMEDY = "Give another name=, or delete the folder to run it again."


@dataclass(frozen=True)
class Stage:
    """One run of a transfer.

    Attributes:
        name: Name of the stage, see the table above.
        fold: Test fold; None for data without folds.
        seed: Seed of all random numbers.
        folder: Run folder.
        command: Command that runs the stage.
        config: All settings of the stage, resolved, except for the file of its weights.
        weights: Checkpoint of the network; None to start from scratch.
        view: Name of the view that panoramas are evaluated in; "" for the view of the transfer.
        condition: Condition that panoramas are evaluated in; "" in other stages.
    """

    name: str
    fold: int | None
    seed: int
    folder: Path
    command: Literal["train", "evaluate"]
    config: dict[str, Any]
    weights: Path | None
    view: str = ""
    condition: str = ""


def plan(config: DictConfig, folder: Path, views: Mapping[str, Mapping[str, Any]]) -> list[Stage]:
    """Plan all stages, grouped by fold and seed.

    Args:
        config: Composed ``transfer.yaml``; ``checkpoint`` is an absolute path or null.
        folder: Folder of the transfer.
        views: Changes of settings by the names of the views, see `transfer_views`. In a study,
            these are all views; else they are compared with the view of the transfer.

    Raises:
        SettingError: A setting of the transfer is invalid.
    """
    if config.label_map is not None and config.checkpoint is None:
        raise SettingError(
            "label_map",
            found=config.label_map,
            expected="null for a network that is trained here, on the classes of the data",
        )
    fold = config.data.get("fold")
    if config.folds is not None and fold is None:
        raise SettingError("folds", found=config.folds, expected="null: this data has no folds")
    folds = [fold] if config.folds is None else numbers(config, "folds", 0)
    seeds = [config.seed] if config.seeds is None else numbers(config, "seeds", 0)
    planners = [_Planner(config, folder, fold, seed) for fold in folds for seed in seeds]
    return [stage for planner in planners for stage in planner.all(views)]


class _Planner:
    """Plans the stages of one fold and seed."""

    def __init__(self, config: DictConfig, folder: Path, fold: int | None, seed: int) -> None:
        self._config, self._fold, self._seed = config, fold, seed
        self._folder = (folder if fold is None else folder / f"fold_{fold}") / f"seed_{seed}"
        self._checkpoint = config.checkpoint

    def all(self, views: Mapping[str, Mapping[str, Any]]) -> Iterator[Stage]:
        settings, study = self._settings(), self._config.study_levels
        if self._has_photos() and not (study and self._checkpoint):
            yield self._stage("P", settings, "evaluate" if self._checkpoint else "train")
        for view, changes in (views if study else {"": {}, **views}).items():
            for condition, of_data in conditions_of(self._config).items():
                name = "-".join(filter(None, ("S", view, condition if of_data else "")))
                stage = self._stage(name, self._settings({**changes, **of_data}))
                yield replace(stage, view=view, condition=condition)
        if not study:
            yield from self._fine_tuned(settings)

    def _has_photos(self) -> bool:
        if "_target_" in self._config.photos.data:
            return True
        if self._checkpoint:
            return False
        raise SettingError(
            "data@photos.data",
            found="none",
            expected="the photos to train P on: data@photos.data=folder_photos photos.data.root=…",
            remedy="Or start from a network that was trained on photos: checkpoint=….",
        )

    def _fine_tuned(self, settings: dict[str, Any]) -> Iterator[Stage]:
        for epochs in numbers(self._config, "fine_tuning.epochs", 1):
            tuned = self._settings({"optimizer": self._fine_tuning_optimizer(settings)})
            tuned["scheduler"] = tuned["fine_tuning"]["scheduler"]
            tuned["trainer"]["max_epochs"] = epochs
            # Not the crops of P's first epochs again.
            tuned["photos"]["data"]["sampling_seed"] = 1
            for on in "PS":
                yield self._stage(f"{on}-FT-{epochs}", tuned, "train")

    def _settings(self, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return all settings, resolved after changes."""
        config: Any = OmegaConf.create(OmegaConf.to_container(self._config))
        config.seed = self._seed
        for data in (config.data, config.photos.data):
            if self._fold is not None and "fold" in data:
                data.fold = self._fold
        for name, value in (changes or {}).items():
            OmegaConf.update(config, name, value, merge=False, force_add=True)
        resolved: Any = OmegaConf.to_container(config, resolve=True)
        return dict(resolved)

    def _fine_tuning_optimizer(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Return the optimizer of fine-tuning, completed with the settings of P's training."""
        tuned, before = settings["fine_tuning"]["optimizer"], settings["optimizer"]
        optimizer = tuned if "_target_" in tuned else before | tuned
        if optimizer.get("lr") is None:
            if before.get("lr") is None:
                raise SettingError(
                    "fine_tuning.optimizer.lr",
                    found="null (a tenth of optimizer.lr), and optimizer.lr is null",
                    expected="a learning rate",
                )
            # Rounded: 3e-3 / 10 is 3.0000000000000003e-4.
            optimizer = optimizer | {"lr": float(f"{before['lr'] / _SLOWER:.12g}")}
        return dict(optimizer)

    def _stage(
        self,
        name: str,
        settings: dict[str, Any],
        command: Literal["train", "evaluate"] = "evaluate",
    ) -> Stage:
        declared = declared_settings(command).keys() - {"checkpoint"}
        if settings["label_map"] is None:
            declared -= {"label_map", "unmapped"}
        config = {key: value for key, value in settings.items() if key in declared}
        config |= {"name": f"{settings['name']}/{name}", "init_from": None, "resume": None}
        if name[0] == "P":
            config |= {key: settings["photos"][key] for key in ("data", "representation")}
        trained = self._folder / "P" / "checkpoints" / "best.ckpt"
        scratch = name == "P" and not self._checkpoint
        return Stage(
            name=name,
            fold=self._fold,
            seed=self._seed,
            folder=self._folder / name,
            command=command,
            config=config,
            weights=None if scratch else Path(self._checkpoint or trained),
        )


def stage_state(stage: Stage) -> State:
    """Determine the progress of a stage from the files in its folder.

    Raises:
        SettingError: The folder has other content, or the stage with other settings.
        DataError: A file of the stage cannot be read.
    """
    record = stage.folder / "stage.digest"
    if not record.is_file():
        if stage.folder.exists() and any(p.name[0] != "." for p in stage.folder.iterdir()):
            raise SettingError(
                stage.folder,
                found="files that tangent-transfer did not write",
                expected="a new folder, or the folder of this stage",
                remedy=_REMEDY,
            )
        return "new"
    finished = (stage.folder / "results.json").is_file()
    begun = stage.command == "train" and (stage.folder / "checkpoints" / "last.ckpt").is_file()
    if not finished and not begun:
        return "new"
    before = read_settings(stage.folder / "config.yaml")
    purpose: Any = "transfer" if stage.command == "train" else "evaluation"
    differing = differing_settings(stage.config, before, purpose)
    if differing:
        named = [f"{name}={then!r} (now {now!r})" for name, now, then in differing]
        raise SettingError(
            stage.folder,
            found=f"stage {stage.name} with {', '.join(named)}",
            expected="the same settings as in this command",
            remedy=_REMEDY,
        )
    weights, known = stage.weights, record.read_bytes()
    # A retrained network has another digest; a removed one does not matter.
    if weights and weights.is_file() and known != _digest(weights, stage.config).encode():
        raise SettingError(
            stage.folder,
            found=f"stage {stage.name} of another network, or with another label map",
            expected=f"the network in {weights} and this label map",
            remedy=_REMEDY,
        )
    return "finished" if finished else "begun"


def run_stage(stage: Stage, state: State) -> int:
    """Start or resume a stage and wait for it.

    Args:
        stage: Stage that is not finished.
        state: Progress of the stage, see `stage_state`.

    Returns:
        Exit status, as in a shell.

    Raises:
        DataError: The checkpoint that the stage starts from is missing.
        SettingError: Another command is running the stage.
    """
    config, digest = dict(stage.config), ""
    if state == "begun":
        config["resume"] = str(stage.folder)
    elif stage.weights is not None:
        if not stage.weights.is_file():
            raise DataError(
                stage.weights,
                found="no such file",
                expected=f"the network that {stage.name} starts from",
                remedy="Delete the stages of this seed to run them all again.",
            )
        config["init_from" if stage.command == "train" else "checkpoint"] = str(stage.weights)
        digest = _digest(stage.weights, config)
    stage.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(stage.folder / ".lock", blocking=False):
            if state == "new":
                write_text(stage.folder / "stage.digest", digest)
            written = OmegaConf.create(_HEAD | without_interpolation(config))
            write_text(stage.folder / "stage.yaml", OmegaConf.to_yaml(written))
            status = run_process(stage_command(stage))
    except Timeout as error:
        raise SettingError(
            stage.folder,
            found=f"another tangent-transfer that is running stage {stage.name}",
            expected="a folder that is not in use",
            remedy="Wait for it; other seeds and folds can run at the same time.",
        ) from error
    return status if status >= 0 else 128 - status


def stage_command(stage: Stage) -> list[str]:
    """Return the command line of a stage."""
    config = (f"--config-dir={stage.folder}", "--config-name=stage")
    return command_line(stage.command, config, stage.folder)


def _digest(weights: Path, config: Mapping[str, Any]) -> str:
    """Hash the network's file and, if there is one, the file of the label map."""
    label_map = str(config.get("label_map") or "")
    map_files = [Path(label_map)] if label_map.lower().endswith(".json") else []
    digest = hashlib.blake2b()
    for path in (weights, *map_files):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()[:32]
