"""Content of a checkpoint."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

from tangent_train.errors import DataError
from tangent_train.files import Text, check_fields, load_plain

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
    return check_fields(path, content, kinds, _EXPECTED)
