"""The stages of a transfer (paper, section "Network transfer"), in the order in which they run.

===========  ===============================================================================
P            trained on photos, tested on photos
S            P's network, tested on panoramas
S-<name>     the same, the panoramas seen through another representation
P-FT-n       P's network, trained on for n epochs on photos, tested on photos
S-FT-n       P's network, trained on for n epochs on panoramas, tested on panoramas
S-level-n    P's network, tested on panoramas of level n (study of the angular resolution)
===========  ===============================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from omegaconf import ListConfig, OmegaConf

from tangent_train.cli.transfer.configs import Settings, StageConfigs
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from omegaconf import DictConfig

__all__ = ["STUDY", "Stage", "checked_study", "folds_and_seeds", "plan", "stage_folder"]

STUDY = "angular_resolution"
"""The one study there is."""


@dataclass(frozen=True)
class Stage:
    """One run of a transfer.

    Attributes:
        name: As above.
        on: What it is tested on.
        fold: The tested fold; None for data without folds.
        seed: Of all its randomness.
        folder: Of the run.
        command: train or evaluate.
        config: All settings of the run but where its weights come from.
        weights: Its network: a checkpoint, or the folder of the run that leaves it; None to start
            from nothing.
        epochs: Of fine-tuning.
        level: Of a study.
    """

    name: str
    on: Literal["photos", "panoramas"]
    fold: int | None
    seed: int
    folder: Path
    command: Literal["train", "evaluate"]
    config: Settings
    weights: Path | None
    epochs: int = 0
    level: int | None = None

    @property
    def representation(self) -> str:
        """How the network sees its images: perspective, tangent, erp, cubemap or another."""
        target = str(self.config["representation"].get("_target_"))
        name = target.rpartition(".")[2].removesuffix("Representation").lower()
        return {"equirect": "erp"}.get(name, name)


def folds_and_seeds(config: DictConfig) -> list[tuple[int | None, int]]:
    """The folds and seeds that are asked for, all stages of one after those of the other.

    Raises:
        SettingError: They are no lists of different numbers, or the data has no folds.
    """
    own = config.data.get("fold")
    folds = _numbers(config, "folds", 0) if config.folds is not None else [own]
    if config.folds is not None and own is None:
        raise SettingError(
            "folds", found=list(config.folds), expected="null: this data has no folds"
        )
    seeds = _numbers(config, "seeds", 0) if config.seeds is not None else [config.seed]
    return [(fold, seed) for fold in folds for seed in seeds]


def stage_folder(folder: Path, fold: int | None, seed: int) -> Path:
    """Where the stages of a fold and a seed are, below the transfer's folder."""
    return (folder if fold is None else folder / f"fold_{fold}") / f"seed_{seed}"


def checked_study(config: DictConfig) -> bool:
    """Whether the study is asked for.

    Raises:
        SettingError: Another one is.
    """
    if config.study not in (None, STUDY):
        raise SettingError("study", found=repr(config.study), expected=f"{STUDY}, or null")
    return config.study is not None


def plan(
    config: DictConfig,
    folder: Path,
    fold: int | None,
    seed: int,
    compared: Mapping[str, Mapping[str, Any]],
) -> list[Stage]:
    """The stages of one fold and seed.

    Args:
        config: The composed ``transfer.yaml``; ``checkpoint``, if any, an absolute path.
        folder: The transfer's.
        fold: The tested fold.
        seed: The seed.
        compared: Sections ``representation`` of the further ways to see panoramas, by name.

    Raises:
        SettingError: A setting of the transfer cannot work.
    """
    planner = _Planner(config, stage_folder(folder, fold, seed), fold, seed)
    return list(planner.study() if checked_study(config) else planner.transfer(compared))


class _Planner:
    def __init__(self, config: DictConfig, folder: Path, fold: int | None, seed: int) -> None:
        self._config = config
        self._configs = StageConfigs(config, fold, seed)
        self._folder = folder
        self._fold = fold
        self._seed = seed
        self._given = config.checkpoint is not None
        self._weights = Path(config.checkpoint) if self._given else folder / "P"

    def transfer(self, compared: Mapping[str, Mapping[str, Any]]) -> Iterator[Stage]:
        photos, panoramas = self._configs.on_photos(), self._configs.on_panoramas()
        yield self._on_photos(photos)
        yield self._stage("S", "panoramas", panoramas)
        for name, representation in compared.items():
            yield self._stage(f"S-{name}", "panoramas", self._configs.on_panoramas(representation))
        for epochs in _numbers(self._config, "fine_tuning.epochs", 1):
            for kind, on, config in (("P", "photos", photos), ("S", "panoramas", panoramas)):
                tuned = self._configs.fine_tuned(config, epochs, seen=on == "photos")
                yield self._stage(f"{kind}-FT-{epochs}", on, tuned, epochs=epochs)

    def study(self) -> Iterator[Stage]:
        if not self._given:
            yield self._on_photos(self._configs.on_photos())
        for level in _numbers(self._config, "study_levels", 0):
            config = self._configs.on_panoramas(level=level)
            yield self._stage(f"S-level-{level}", "panoramas", config, level=level)

    def _on_photos(self, config: Settings) -> Stage:
        """P: trained, or given and only evaluated."""
        stage = self._stage("P", "photos", config)
        return stage if self._given else replace(stage, command="train", weights=None)

    def _stage(
        self,
        name: str,
        on: Any,
        config: Settings,
        epochs: int = 0,
        level: int | None = None,
    ) -> Stage:
        return Stage(
            name=name,
            on=on,
            fold=self._fold,
            seed=self._seed,
            folder=self._folder / name,
            command="train" if epochs else "evaluate",
            config=config | {"name": f"{self._config.name}/{name}"},
            weights=self._weights,
            epochs=epochs,
            level=level,
        )


def _numbers(config: DictConfig, setting: str, least: int) -> Sequence[int]:
    found = OmegaConf.select(config, setting)
    numbers: list[Any] = list(found) if isinstance(found, list | ListConfig) else [None]
    whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= least for n in numbers)
    if not whole or len(set(numbers)) < len(numbers):
        raise SettingError(
            setting, found=found, expected=f"a list of different whole numbers from {least}"
        )
    return numbers
