"""Label maps: the classes of one data set as those of another.

A map is a JSON file with the names of source classes for every target class::

    {"source": "ADE20K", "classes": {"wall": ["wall", "painting"], "floor": ["floor", "rug"]}}

The probability of a target class is the sum of the probabilities of its source classes.

Names are compared without case, and with hyphens and underscores as spaces. If a network names a
class by several synonyms ("windowpane, window"), only the first is compared; a map may list several
names (``"windowpane", "window"``). A network may lack some of the source classes. A target class
without source classes in the network is not predicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from datamodules.core.label_map import PIXEL_CLASSES, LabelMap, plain_name, read_label_map
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.errors import SettingError

Unmapped = Literal["unknown", "never"]
"""Treatment of source classes that are not in a map: label 0 where they win, or they never win."""

_FOLDER = Path(__file__).with_suffix("")
"""Folder with the maps of this package, ``label_maps/<name>.json``."""


@dataclass(frozen=True)
class MappedNetwork:
    """A network with the classes of a map.

    Attributes:
        loaded: The network.
        classes: Classes of the original network in each target class.
        absent: Source classes of the map that the original network lacks.
        unmapped: Other classes of the original network.
        unmapped_wins: True if unmapped classes may win, as label 0.
    """

    loaded: LoadedNetwork
    classes: Mapping[str, Sequence[str]]
    absent: Sequence[str]
    unmapped: Sequence[str]
    unmapped_wins: bool

    def __str__(self) -> str:
        """Return a description in one line."""
        parts = [f"{n} ← {', '.join(names)}" for n, names in self.classes.items() if names]
        missing = [name for name, names in self.classes.items() if not names]
        if missing:
            parts.append(f"not predicted: {', '.join(missing)}")
        if self.absent:
            parts.append(f"not in the network: {', '.join(self.absent)}")
        if self.unmapped:
            effect = "unknown where they win" if self.unmapped_wins else "never win"
            parts.append(f"{effect}: {', '.join(self.unmapped)}")
        return "; ".join(parts)


def load_label_map(given: str | Path) -> LabelMap:
    """Load a label map.

    Args:
        given: Name of a map of this package, such as ``ade20k_to_stanford2d3ds``, or the path of a
            file with the suffix ``.json``.

    Raises:
        SettingError: There is no map of this name.
        DataError: The file is not a valid label map.
    """
    given = str(given)
    shipped = sorted(path.stem for path in _FOLDER.glob("*.json"))
    if given in shipped:
        path = _FOLDER / f"{given}.json"
    elif given.lower().endswith(".json"):
        path = Path(given)
    else:
        raise SettingError(
            "label_map", found=given, expected=f"{', '.join(shipped)}; or a file my_map.json"
        )
    return read_label_map(path)


def map_classes(
    loaded: LoadedNetwork,
    label_map: LabelMap,
    unmapped: Unmapped = "unknown",
    targets: Sequence[str] | None = None,
) -> MappedNetwork:
    """Return a network with the classes of a map instead of its own.

    Args:
        loaded: The network.
        label_map: The map.
        unmapped: Treatment of classes that are not in the map. Unknown classes of an imported
            network remain unknown.
        targets: All target classes in order, without unknown; None for the classes of the map.

    Raises:
        SettingError: The map contains no class of the network, or a target that is not in
            `targets`.
    """
    targets = label_map.names if targets is None else targets
    foreign = set(label_map.names) - set(targets)
    if foreign:
        raise SettingError(
            "label_map",
            found=f"target classes {', '.join(sorted(foreign))}",
            expected=f"names among {', '.join(targets)}",
        )
    target_of = {
        str(key): label_map.names[label - 1] for key, label in label_map.labels.items() if label
    }
    loaded.check_predicts(PIXEL_CLASSES, "Leave label_map out.")
    names = loaded.class_names[1:]
    groups = loaded.groups or [[k] for k in range(len(names))]
    members: dict[str | None, list[int]] = {name: [] for name in (*targets, None)}
    for k, name in enumerate(names):
        members[target_of.get(plain_name(name))].append(k)
    remaining = members.pop(None)
    if len(remaining) == len(names):
        raise SettingError(
            "label_map",
            found=f"no class of the map in a network of {', '.join(names)}",
            expected="a map whose source classes include the network's",
        )
    if remaining and unmapped == "never" and loaded.score_kind == "labels":
        raise SettingError(
            "unmapped",
            found="never, for a network that returns labels",
            expected="unknown, because labels have no second best class",
        )
    scores = [[k for member in group for k in groups[member]] for group in members.values()]
    unknown = [k for group in groups[len(names) :] for k in group]
    if unmapped == "unknown":
        unknown += [k for member in remaining for k in groups[member]]
    scores += [unknown] if unknown else []
    found = {str(target): [names[k] for k in group] for target, group in members.items()}
    return MappedNetwork(
        loaded=replace(loaded, class_names=("unknown", *targets), groups=tuple(map(tuple, scores))),
        classes=found,
        absent=[n for n in target_of if n not in map(plain_name, names)],
        unmapped=[names[k] for k in remaining],
        unmapped_wins=unmapped == "unknown",
    )
