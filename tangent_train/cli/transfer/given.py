"""Whether a transfer can start from a given network instead of training one on photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from tangent_train.cli.resume import differing_settings
from tangent_train.cli.stored import checkpoint_config
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["check_given"]


def check_given(config: DictConfig, folds: Sequence[int | None]) -> None:
    """Refuse a checkpoint of another network, of other classes or of another fold.

    Args:
        config: The composed ``transfer.yaml``.
        folds: The folds that are asked for.

    Raises:
        DataError: It is no checkpoint of tangent-train.
        SettingError: The transfer cannot start from it.
    """
    from tangent_train.tasks.stored_settings import check_stored, named_targets
    from tangent_train.tasks.trained import read_checkpoint

    path = Path(config.checkpoint)
    content = read_checkpoint(path)
    kind = content.get("kind", "segmentation")
    if kind != "segmentation":
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network for {kind}",
            expected="one for segmentation: a transfer compares labels of pixels",
        )
    wanted: Any = OmegaConf.to_container(config, resolve=True)
    stored = checkpoint_config(path, named_targets(content["config"]))  # compared, not called
    check_stored(path, stored["data"], named_targets(wanted))  # but this is imported
    given: Any = OmegaConf.to_container(OmegaConf.create(stored), resolve=True)
    _check_network(path, given, wanted)
    theirs = _classes(given["data"])
    for data in (wanted["data"], wanted["photos"]["data"]):
        if _classes(data) != theirs:
            raise SettingError(
                f"checkpoint={path}",
                found=f"a network for the classes of {given['data']['_target_']}",
                expected=f"those of {data['_target_']}",
            )
    fold = given["data"].get("fold")
    if fold is not None and set(folds) != {fold}:
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network for testing on fold {fold}, of the others it has seen the rooms",
            expected=f"folds=[{fold}]",
        )


def _check_network(path: Path, given: dict[str, Any], wanted: dict[str, Any]) -> None:
    from tangent_train.tasks.networks import PRETRAINED

    now, then = (
        {"network": config["network"], "data": {"inputs": config["data"].get("inputs")}}
        for config in (wanted, given)
    )
    # Where a network began does not matter once it is trained.
    free = [f"network.{name}" for name in PRETRAINED]
    differing = differing_settings(now, then, free)
    if differing:
        name, value, before = differing[0]
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network with {name}={before!r}",
            expected=f"{value!r}, as here",
            remedy=f"Set {name} as it was, or train P here: leave checkpoint= out.",
        )


def _classes(data: dict[str, Any]) -> tuple[str, ...]:
    names: tuple[str, ...] = tuple(get_class(data["_target_"]).class_names)  # type: ignore[attr-defined]
    return names
