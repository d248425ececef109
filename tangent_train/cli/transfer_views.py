"""Views and conditions of the panoramas that a transfer evaluates its network on.

Both are lists of named settings: ``compare`` changes the representation, ``conditions`` the data.
Every view is evaluated in every condition, on the same panoramas with the same rotations.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.checkpoints.scores import network_for_views
from tangent_train.console import print_text
from tangent_train.errors import SettingError
from tangent_train.inference.representations import panorama_settings

_NAME = re.compile(r"\w[\w.+-]*")
"""Names that can be part of a folder's name."""


def views_of(config: DictConfig, trained: LoadedNetwork | None) -> dict[str, dict[str, Any]]:
    """Return the views of ``compare`` or of the study by name, each as changes of settings.

    A view is an option of ``representation`` (a name alone, or ``option``) with changed settings;
    without an option, it is the transfer's own representation with changed settings. ``level`` also
    sets the level of the stage; names such as ``task.head.align`` change the task. Distortion-aware
    views of a network that does not allow them are left out.

    Args:
        config: Composed ``transfer.yaml``.
        trained: Network from a file without settings of a run; else None.

    Raises:
        SettingError: The list is invalid.
    """
    if config.study_levels:
        most = config.study_max_rows
        levels = {n: 2 ** (n + 1) for n in numbers(config, "study_levels", 0)}
        heights = {n: rows if most is None else min(rows, most) for n, rows in levels.items()}
        return {
            f"level-{n}": _view(config, trained, level=n, erp_height=rows)
            for n, rows in heights.items()
        }
    chosen = HydraConfig.get().runtime.choices.get("representation")
    views = {
        name: _view(config, trained, **(changes or {"option": name}))
        for name, changes in _named_entries(config, "compare").items()
        if changes or name != chosen
    }
    if trained is None:
        return views
    return {name: view for name, view in views.items() if _is_possible(name, view, trained)}


def _is_possible(name: str, view: Mapping[str, Any], trained: LoadedNetwork) -> bool:
    """Return False, and print the reason, if a network cannot be distortion-aware."""
    try:
        network_for_views(trained.network, view["representation"].get("distortion_aware"))
    except SettingError as error:
        print_text(f"View {name} is left out: {error}")
        return False
    return True


def conditions_of(config: DictConfig) -> dict[str, dict[str, Any]]:
    """Return the conditions of the test panoramas by name, each as changes of settings.

    Args:
        config: Composed ``transfer.yaml``.

    Raises:
        SettingError: The list is invalid.
    """
    conditions = _named_entries(config, "conditions")
    if not conditions:
        raise SettingError("conditions", found="[]", expected="at least one: [upright]")
    return {n: {f"data.{key}": v for key, v in c.items()} for n, c in conditions.items()}


def numbers(config: DictConfig, setting: str, least: int) -> list[int]:
    """Return a list of different whole numbers.

    Args:
        config: Composed ``transfer.yaml``.
        setting: Name of the list, ``section.setting``.
        least: Smallest allowed number.

    Raises:
        SettingError: The list has other values, or equal ones.
    """
    value = OmegaConf.select(config, setting)
    numbers: list[Any] = list(value) if isinstance(value, list | ListConfig) else [None]
    if not all(type(n) is int and n >= least for n in numbers) or len(set(numbers)) < len(numbers):
        expected = f"a list of different whole numbers, {least} or more"
        raise SettingError(setting, found=value, expected=expected)
    return numbers


def _view(
    config: DictConfig, trained: LoadedNetwork | None, option: str | None = None, **changes: Any
) -> dict[str, Any]:
    """Return a view as changes of settings: its representation, and its level if it has one.

    Args:
        config: Composed ``transfer.yaml``.
        trained: Network from a file without settings of a run; else None.
        option: Option of the group ``representation``; None for the representation of the transfer.
        **changes: Changed settings of the representation, or of the task.
    """
    of_task = {name: changes.pop(name) for name in [*changes] if name.startswith("task.")}
    level = changes.get("level")
    composed: Any = OmegaConf.to_container(config.representation)
    section: Any
    if option is not None:
        search = [s for s in HydraConfig.get().overrides.hydra if s.startswith("hydra.searchpath")]
        # Composed alone, so that its references to other settings are not resolved.
        section = OmegaConf.to_container(compose(f"representation/{option}", search).representation)
    elif trained is not None and {"level", "base_level"} & changes.keys():
        of_level = panorama_settings(trained, level, changes.get("base_level"))
        section = composed if composed["_target_"] == of_level["_target_"] else {}
        section |= of_level
    else:
        section = composed
        dim = config.representation.get("dim")
        if level is not None and dim is not None:  # a side in pixels
            section["dim"] = max(1, round(dim * 2.0 ** (level - config.level)))
    rows = config.representation.get("erp_height")
    if rows is None and level is not None:
        rows = 2 ** (config.level + 1)
    section |= ({} if rows is None else {"erp_height": rows}) | changes
    return {"representation": section, **of_task} | ({} if level is None else {"level": level})


def _named_entries(config: DictConfig, setting: str) -> dict[str, dict[str, Any]]:
    """Return the entries of a list, names or named settings, as settings by name."""
    value = config[setting]
    entries: Any = OmegaConf.to_container(value) if isinstance(value, ListConfig) else [None]
    named: dict[str, dict[str, Any]] = {}
    for entry in entries:
        settings = {"name": entry} if isinstance(entry, str) else entry
        name = settings.get("name") if isinstance(settings, dict) else None
        if not isinstance(name, str) or not _NAME.fullmatch(name) or name in named:
            raise SettingError(
                setting,
                found=entry if isinstance(value, ListConfig) else value,
                expected="a list of different names, or of settings with such a name: "
                "[one, {name: another, …}]",
            )
        named[name] = {key: inner for key, inner in settings.items() if key != "name"}
    return named
