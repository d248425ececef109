"""Content of a checkpoint and of the settings of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from tangent_train.config.build import Text, check_fields, check_plain
from tangent_train.errors import DataError, first_line
from tangent_train.files import load_plain, write_text

INPUTS = list[Literal["rgb", "depth", "elevation"]]
"""Inputs of a network; equal to `datamodules.core.inputs.Input`, which is slow to import."""

NORMALIZATION = dict[str, list[float]]
"""The ``mean`` and ``std`` of a network's inputs."""

_FIELDS = {
    "config": dict,
    "class_names": list[Text],  # empty for depth networks
    "epoch": int | None,  # the last epoch that has begun, from 0
    "inputs": INPUTS | None,  # None for shapes, which have six fixed channels
    "normalization": NORMALIZATION,
    "state_dict": dict,
}
_EXPECTED = "a checkpoint written by tangent-train"


def read_checkpoint(path: Path, needed: Collection[str] = tuple(_FIELDS)) -> dict[str, Any]:
    """Read fields of a checkpoint; only tensors and plain values are unpickled.

    Args:
        path: Checkpoint. Tensors are memory-mapped.
        needed: Names of the fields: ``config`` (the resolved settings of the run, plain values),
            ``class_names``, ``epoch``, ``inputs``, ``normalization``, ``state_dict``.

    Raises:
        DataError: The file is missing, damaged, or not a checkpoint of this program.
    """
    if path.is_dir():
        remedy = "Use its checkpoints/best.ckpt."
        raise DataError(path, found="a folder", expected=_EXPECTED, remedy=remedy)
    content = load_plain(path, _EXPECTED, mmap=True)
    kinds = {name: kind for name, kind in _FIELDS.items() if name in needed}
    checked = check_fields(path, content, kinds, _EXPECTED)
    if "config" in checked:
        checked["config"] = check_plain(path, checked["config"], "config")
    return checked


def read_settings(path: Path) -> dict[str, Any]:
    """Read the settings of a run from a file that `write_settings` wrote.

    Nothing is interpolated: ``${oc.env:HOME}`` is an ordinary string. Aliases, by which a few lines
    can expand to more than fits into memory, merged mappings (``<<``) and repeated names are
    refused.

    Raises:
        DataError: The file is missing, or is not such a file.
    """
    expected = "the settings of a run, without aliases"
    try:
        content = _Loader(path.read_text(encoding="utf-8")).get_single_data()
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        found = first_line(f"{type(error).__name__}: {error}")
        raise DataError(path, found=found, expected=expected) from error
    if not isinstance(content, dict):
        raise DataError(path, found=type(content).__name__, expected=expected)
    settings: dict[str, Any] = check_plain(path, content, "settings")
    return settings


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: Any) -> None:
        """Refuse repeated names, of which PyYAML takes the last one."""
        names = [(name.tag, str(name.value)) for name, _ in node.value]
        if len(set(names)) < len(names):
            raise yaml.YAMLError(f"a repeated name among {', '.join(n for _, n in names)}")


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        """Write repeated values without aliases."""
        return True


def write_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings as YAML, with strings quoted so that every reader takes them literally.

    Raises:
        DataError: The settings have values that `read_settings` and `read_checkpoint` refuse.
    """
    check_plain(path, settings, "settings")
    write_text(path, yaml.dump(dict(settings), Dumper=_Dumper, sort_keys=False, allow_unicode=True))
