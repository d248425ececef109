"""Whether a transfer can start from a given network instead of training one on photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from tangent_train.errors import SettingError
from tangent_train.registry import check_fields, check_plain, maker_of
from tangent_train.setting_rules import differing_settings

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
    from tangent_train.checkpoints.content import read_checkpoint

    path = Path(config.checkpoint)
    content = read_checkpoint(path)
    if content["kind"] != "segmentation":
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network for {content['kind']}",
            expected="one for segmentation: a transfer compares labels of pixels",
        )
    wanted: Any = OmegaConf.to_container(config, resolve=True)
    plain = check_plain(path, content["config"], "config")
    given = check_fields(path, plain, {"network": dict, "data": dict}, "the settings of a run")
    _check_network(path, given, wanted)
    for name, data in (("data", wanted["data"]), ("photos.data", wanted["photos"]["data"])):
        classes = getattr(maker_of(data, name), "class_names", content["class_names"])
        if list(classes) != content["class_names"]:
            raise SettingError(
                f"checkpoint={path}",
                found=f"a network for {', '.join(content['class_names'])}",
                expected=f"one for {', '.join(classes)}, the classes of {data['_target_']}",
            )
    fold = given["data"].get("fold")
    if fold is not None and set(folds) != {fold}:
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network for testing on fold {fold}, of the others it has seen the rooms",
            expected=f"folds=[{fold}]",
        )


def _check_network(path: Path, given: dict[str, Any], wanted: dict[str, Any]) -> None:
    from tangent_train.checkpoints.trained import completed_settings

    # What the data says of a network, and where it began, does not matter once it is trained.
    now, then = (
        {
            "network": completed_settings(config["network"], 0, 0, restored=True),
            "data": {"inputs": config["data"].get("inputs")},
        }
        for config in (wanted, given)
    )
    free = [f"network.{name}" for name in ("in_channels", "num_classes", "classes")]
    differing = [d for d in differing_settings(now, then, "transfer") if d[0] not in free]
    if differing:
        name, value, before = differing[0]
        raise SettingError(
            f"checkpoint={path}",
            found=f"a network with {name}={before!r}",
            expected=f"{value!r}, as here",
            remedy=f"Set {name} as it was, or train P here: leave checkpoint= out.",
        )
