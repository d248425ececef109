"""Content of a checkpoint and of the settings of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml  # type: ignore[import-untyped]

from tangent_train.errors import DataError, first_line
from tangent_train.files import load_plain, write_text
from tangent_train.registry import Text, check_fields, check_plain

INPUTS = list[Literal["rgb", "depth", "elevation"]]
"""Inputs of a network, see `datamodules.core.inputs.Input`, which is slow to import."""

NORMALIZATION = dict[str, list[float]]
"""Its ``mean`` and ``std``."""

GROUPS = list[list[int]] | None
"""The scores of a photo network that make each class, see `Groups`."""

ScoreKind = Literal["logits", "probabilities", "sigmoid_logits", "sigmoid", "labels"]
"""Output of a network.

* `logits`: scores before a softmax over the K classes.
* `probabilities`: scores after that softmax.
* `sigmoid_logits`: scores before a sigmoid of every class. They get a further score of 0 in place
  K, "none of the classes", which wins where no class has a probability above ½.
* `sigmoid`: probabilities after that sigmoid, with the same place K.
* `labels`: label maps ``(B, h, w)`` or ``(B, 1, h, w)``. Other values than 0 … K − 1, and NaN, are
  in place K.
"""

_FIELDS = {
    "config": dict,
    "class_names": list[Text],
    "fixed_size": list[int] | None,  # of imported networks
    "epoch": int | None,  # of runs: the last that has begun, from 0
    "groups": GROUPS,
    "inputs": INPUTS | None,  # None of shapes, whose six channels are all there is
    "normalization": NORMALIZATION,
    "photo_level": int | None,  # of imported networks
    "predicts": Text,  # what the network gives, see `datamodules.core.labels`
    "score_kind": ScoreKind | None,  # of imported networks; None: logits
    "state_dict": dict,
}
_EXPECTED = "a checkpoint written by tangent-train"


def read_checkpoint(path: Path, needed: Collection[str] = tuple(_FIELDS)) -> dict[str, Any]:
    """The content of a checkpoint; nothing but tensors and plain values is unpickled.

    Args:
        path: The file; tensors are memory-mapped, and compared with their checksums if needed.
        needed: Which of its fields: ``config`` (the resolved settings of the run, plain values),
            ``class_names``, ``epoch``, ``fixed_size``, ``groups``, ``inputs``,
            ``normalization``, ``photo_level``, ``predicts``, ``score_kind``, ``state_dict``.

    Raises:
        DataError: The file is missing, damaged, no checkpoint, or of another program.
    """
    if path.is_dir():
        remedy = "Give its checkpoints/best.ckpt."
        raise DataError(path, found="a folder", expected=_EXPECTED, remedy=remedy)
    content = load_plain(path, _EXPECTED, mmap=True, whole="state_dict" in needed)
    kinds = {name: kind for name, kind in _FIELDS.items() if name in needed}
    found = check_fields(path, content, kinds, _EXPECTED)
    if "config" in found:
        found["config"] = check_plain(path, found["config"], "config")
    return found


def read_settings(path: Path) -> dict[str, Any]:
    """The settings of a run, from the file that `write_settings` wrote.

    Nothing is interpolated: ``${oc.env:HOME}`` is an ordinary string. Aliases, by which a few lines
    can stand for more than fits into memory, are not followed, nor are mappings merged (``<<``);
    every name is there once.

    Raises:
        DataError: It is missing, or something else.
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
        """Refuse names that are there twice, of which PyYAML takes the last one."""
        names = [(name.tag, str(name.value)) for name, _ in node.value]
        if len(set(names)) < len(names):
            raise yaml.YAMLError(f"a name twice among {', '.join(n for _, n in names)}")


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        """Write out what appears twice."""
        return True


def write_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings as YAML, with strings quoted so that every reader takes them literally.

    Raises:
        DataError: They hold what `read_settings` and `read_checkpoint` refuse.
    """
    check_plain(path, settings, "settings")
    write_text(path, yaml.dump(dict(settings), Dumper=_Dumper, sort_keys=False, allow_unicode=True))
