"""The configs of the stages of a transfer, made of the transfer's own.

A stage is a run of ``tangent-train`` or ``tangent-evaluate``: its config has the settings of
``train.yaml``. ``data`` and ``representation`` are those of the panoramas or, for stages on photos,
the sections below ``photos``; fine-tuning takes optimizer and scheduler from ``fine_tuning``.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from omegaconf import DictConfig

__all__ = ["Settings", "StageConfigs"]

Settings = dict[str, Any]
"""Plain values, with references to others (``${level}``) as they are written."""

_OF_THE_TRANSFER = frozenset(
    {
        "photos",
        "fine_tuning",
        "compare",
        "folds",
        "seeds",
        "checkpoint",
        "study",
        "study_levels",
        "study_max_rows",
    }
)
"""Settings that a stage's config does not have."""

_REFERENCE = re.compile(r"\$\{\s*(\.*)([^${}:,]*)(:?)")
_SLOWER = 10  # fine-tuning: 1e-5 after 1e-4 (paper, supplement, "Transfer learning")


class StageConfigs:
    """Configs for one fold and seed.

    References to settings that a stage's config has as well stay what they are: ``level=9`` reaches
    the checkpoint of a stage as it does any other. All others are replaced by what they refer to.

    Args:
        config: The composed ``transfer.yaml``.
        fold: The tested fold; None for the data's own.
        seed: The seed.
    """

    def __init__(self, config: DictConfig, fold: int | None, seed: int) -> None:
        written: Any = OmegaConf.to_container(config, resolve=False)
        written["seed"] = seed
        for data in (written["data"], written["photos"]["data"]):
            if fold is not None and "fold" in data:
                data["fold"] = fold
        self._written = written
        self._resolved: Any = OmegaConf.to_container(OmegaConf.create(written), resolve=True)
        self._names = tuple(name for name in written if name not in _OF_THE_TRANSFER)

    def on_panoramas(
        self, representation: Mapping[str, Any] | None = None, level: int | None = None
    ) -> Settings:
        """Of a stage on panoramas.

        Args:
            representation: Instead of the transfer's; it gets the transfer's rows.
            level: Instead of the transfer's.
        """
        config = {name: self._part((name,), self._names) for name in self._names}
        config |= {"init_from": None, "resume": None}
        if representation is not None:
            rows = {"erp_height": config["representation"].get("erp_height")}
            rows = rows if "erp_height" in representation else {}
            config["representation"] = {**representation, **rows}
        return config if level is None else self._at_level(config, level)

    def on_photos(self) -> Settings:
        """Of a stage on photos."""
        kept = set(self._names) - {"data", "representation"}
        photos = {name: self._part(("photos", name), kept) for name in ("data", "representation")}
        return self.on_panoramas() | photos

    def fine_tuned(self, config: Settings, epochs: int, *, seen: bool) -> Settings:
        """Of the same stage, fine-tuned.

        Args:
            config: From `on_panoramas` or `on_photos`.
            epochs: For how long.
            seen: Whether the network was trained on these images: then it gets others of them than
                those of its first epochs again.

        Raises:
            SettingError: There is no learning rate of which to take a tenth.
        """
        kept = set(self._names) - {"optimizer", "scheduler"}
        optimizer = self._part(("fine_tuning", "optimizer"), kept)
        if "_target_" not in optimizer:  # else it is one by itself
            optimizer = {**self._resolved["optimizer"], **optimizer}
        if optimizer.get("lr") is None:
            optimizer["lr"] = self._slower_rate()
        scheduler = self._part(("fine_tuning", "scheduler"), kept | {"optimizer"})
        trainer = {**config["trainer"], "max_epochs": epochs}
        data = {**config["data"], "stream": 1} if seen else config["data"]
        tuned = {"data": data, "optimizer": optimizer, "scheduler": scheduler, "trainer": trainer}
        return config | tuned

    def _slower_rate(self) -> float:
        rate = self._resolved["optimizer"].get("lr")
        if not isinstance(rate, int | float):
            raise SettingError(
                "fine_tuning.optimizer.lr",
                found=f"null, a tenth of optimizer.lr, which is {rate!r}",
                expected="a learning rate",
            )
        return float(f"{rate / _SLOWER:.12g}")  # 3e-4 of 3e-3, not 3.0000000000000003e-4

    def _at_level(self, config: Settings, level: int) -> Settings:
        """The same panoramas at another resolution, no finer than their files."""
        representation = {**config["representation"]}
        if "${" not in str(representation.get("level")):
            representation["level"] = level
        rows = 2 ** (level + 1)
        most = self._resolved["study_max_rows"]
        representation["erp_height"] = rows if most is None else min(rows, most)
        if representation.get("dim") is not None:
            own = self._resolved["level"]
            representation["dim"] = max(1, round(representation["dim"] * 2.0 ** (level - own)))
        return config | {"level": level, "representation": representation}

    def _part(self, path: tuple[str, ...], kept: Collection[str]) -> Any:
        written, resolved = self._written, self._resolved
        for name in path:
            written, resolved = written[name], resolved[name]
            if isinstance(written, str):  # a whole section that is elsewhere
                written = resolved
        return _without_foreign(written, resolved, kept)


def _without_foreign(written: Any, resolved: Any, kept: Collection[str]) -> Any:
    """What is written, with what is resolved where it refers to other settings than those kept."""
    if isinstance(written, dict):
        return {key: _without_foreign(value, resolved[key], kept) for key, value in written.items()}
    if isinstance(written, list):
        pairs = zip(written, resolved, strict=True)
        return [_without_foreign(value, other, kept) for value, other in pairs]
    return written if not isinstance(written, str) or _is_at_home(written, kept) else resolved


def _is_at_home(text: str, kept: Collection[str]) -> bool:
    for dots, name, colon in _REFERENCE.findall(text):
        if colon:
            known = name == "oc.env"
        else:
            known = len(dots) == 1 or (not dots and re.split(r"[.\[]", name)[0].strip() in kept)
        if not known:
            return False
    return True
