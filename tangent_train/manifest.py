"""Manifest of an output folder: the settings that decide its content, and what is finished.

Every command that writes many files opens the manifest of its folder first. A folder with the same
settings is continued with what is missing; a folder with others is refused, and nothing is written,
unless nothing in it is finished and no other process shares it.
Shards of one work (`items[i::n]`) share the folder and its settings.

A folder holds ``manifest.json``, and for each shard a file ``finished*.jsonl`` with a line for each
finished item.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

from tangent_train.errors import SettingError

MANIFEST = "manifest.json"

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Shard:
    """One of several parts of a list: ``items[number - 1 :: count]``.

    Attributes:
        number: Number of the part, from 1 to `count`.
        count: Number of parts.
    """

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, setting: str | int | None) -> Self:
        """Return the part that the setting ``shard`` names; None for the whole list.

        Raises:
            SettingError: The setting does not name a part.

        >>> Shard.parse("3/16")
        Shard(number=3, count=16)
        """
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", str(setting or "1/1"), re.ASCII)
        shard = cls(*map(int, match.groups())) if match else cls(0)
        if not 1 <= shard.number <= shard.count:
            expected = "number/count, such as 1/16 to 16/16, or null"
            raise SettingError("shard", found=setting, expected=expected)
        return shard

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, items: Sequence[_Item]) -> Sequence[_Item]:
        """Return the items of a list that belong to the part.

        >>> Shard(2, 3).part("abcdefg")
        'be'
        """
        return items[self.number - 1 :: self.count]


def check_only_results(folder: Path) -> None:
    """Refuse an output folder with files that no command wrote.

    Raises:
        SettingError: The folder holds other files.
    """
    others = folder.iterdir() if folder.exists() and not (folder / MANIFEST).is_file() else ()
    if any(other.name[0] != "." for other in others):
        expected = "a new or empty folder, or one that this command began"
        found = f"{folder}, which holds other files"
        raise SettingError("output", found=found, expected=expected)


def check_continues(folder: Path, settings: Mapping[str, Any], ignored: Collection[str]) -> None:
    """Refuse an output folder that `Manifest.open` would refuse, before the work is prepared.

    Args:
        folder: Output folder.
        settings: Settings of the command, plain values.
        ignored: Names of settings that are stored otherwise, or not known yet.

    Raises:
        SettingError: The folder holds other files, or items finished with other settings.
    """
    check_only_results(folder)
    if _finished(folder):
        before = json.loads((folder / MANIFEST).read_bytes())
        wanted = json.loads(json.dumps(settings))
        _check_same(folder, wanted, before, before.keys() & wanted.keys() - {*ignored})


def _check_same(
    folder: Path, wanted: Mapping[str, Any], before: Mapping[str, Any], names: Iterable[str]
) -> None:
    for name in sorted(names):
        found, old = ("null" if s.get(name) is None else s[name] for s in (wanted, before))
        if found != old:
            remedy = "Choose another output, or delete this one to write it again."
            expected = f"{old}, with which {folder} was written"
            raise SettingError(name, found=found, expected=expected, remedy=remedy)


def _finished(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of the finished items of all shards by name."""
    finished: dict[str, dict[str, Any]] = {}
    for file in sorted(folder.glob("finished*.jsonl")):
        for line in file.read_text("utf-8").splitlines():
            with suppress(ValueError):  # a line that was cut off by a kill
                entry = json.loads(line)
                finished[entry.pop("item")] = entry
    return finished


@dataclass
class Manifest:
    """Settings and finished items of an output folder, created by `open`.

    Attributes:
        folder: Output folder.
        finished: Entry of each finished item of all shards, by its name. An entry holds plain
            values, e.g. the counts of a summary.
    """

    folder: Path
    finished: dict[str, dict[str, Any]] = field(default_factory=dict)
    _shard: Shard = field(default_factory=Shard)

    @classmethod
    def open(
        cls,
        folder: Path,
        settings: Mapping[str, Any],
        shard: Shard | None = None,
        *,
        is_shared: bool = False,
    ) -> Self:
        """Create an output folder, or continue one that was written with the same settings.

        Args:
            folder: Output folder: new, empty, begun with the same settings, or nothing is finished.
            settings: Settings that decide the content, plain values; paths as text.
            shard: Part of the work that this process does; None for all of it.
            is_shared: True if several processes may begin at once, as shards do: the first one
                decides the settings.

        Raises:
            SettingError: The folder holds other files, or items finished with other settings.
        """
        path = folder / MANIFEST
        wanted = json.loads(json.dumps(settings))  # tuples become lists, as in the file
        check_only_results(folder)
        finished = _finished(folder)
        shard = shard or Shard()
        if not (finished or is_shared or shard.count > 1):
            path.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError), path.open("x", encoding="utf-8") as new:
            new.write(json.dumps(wanted, indent=1) + "\n")
        before = json.loads(path.read_bytes())
        _check_same(folder, wanted, before, before.keys() | wanted.keys())
        return cls(folder, finished, shard)

    def missing(self, names: Iterable[str]) -> list[str]:
        """Return the names of items that are not finished, in their order."""
        return [name for name in names if name not in self.finished]

    def finish(self, name: str, **entry: Any) -> None:
        """Note that an item is finished; call it after its files were written.

        Args:
            name: Name of the item.
            **entry: Plain values to keep with it.
        """
        self.finished[name] = entry
        shard = self._shard
        suffix = "" if shard.count == 1 else f"-{shard.number}-of-{shard.count}"
        with (self.folder / f"finished{suffix}.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps({"item": name, **entry}) + "\n")
