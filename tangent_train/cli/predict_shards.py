"""Shards of predictions: store the results of each in a file, and combine them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tangent_train.cli.jobs import Shard
from tangent_train.errors import SettingError
from tangent_train.files import write_text
from tangent_train.results.predictions import Entry


@dataclass(frozen=True)
class PredictionShard:
    """One of the shards of predictions, which exchange results through their files.

    Attributes:
        shard: Number of the shard, and number of all shards.
        folder: Folder of the files of all shards, e.g. ``3-of-16.json``.
        names: Names of the images and videos of all shards, in order.
        settings: Settings that all shards must share.
    """

    shard: Shard
    folder: Path
    names: Sequence[str]
    settings: Mapping[str, Any]

    @property
    def path(self) -> Path:
        """File of the shard, written when it begins."""
        return self._path(self.shard.number)

    def begin(self, entries: Sequence[Entry], *, resume: bool, overwrite: bool) -> None:
        """Mark the shard as begun.

        Args:
            entries: Entries of images done before.
            resume: True if the shard may have begun before.
            overwrite: True if earlier files may be replaced.

        Raises:
            SettingError: The shard has begun before, or files in the folder are of other shards.
        """
        known = self.path.exists()
        if known and not (resume or overwrite):
            raise SettingError(
                "shard",
                found=f"{self.shard}, which has {self.path}",
                expected="a shard that has not begun",
                remedy="Continue it with resume=true, or repeat it with overwrite=true.",
            )
        # Saved before the check: if two that do not fit begin together, one of them finds it.
        self.save(entries)
        for path in self.folder.glob("[!.]*.json"):
            if not (content := _read(path)):
                continue  # removed by its process
            differing = [name for name, value in self._common.items() if content.get(name) != value]
            if differing and not overwrite:
                if not known:
                    self.path.unlink()
                name = differing[0]
                found, others = f"{name}={self._common[name]}", f" ({content.get(name)})"
                if name == "names":
                    found, others = "images of other names", ""
                raise SettingError(
                    "shard",
                    found=f"{found} than those of {path}{others}",
                    expected="the same images and settings for all shards of a folder",
                    remedy="Choose another output, or set overwrite=true.",
                )
            if "shards" in differing:  # files of the same number are replaced one by one
                path.unlink(missing_ok=True)

    def save(self, entries: Sequence[Entry], *, done: bool = False) -> None:
        """Write the file of the shard.

        Args:
            entries: Entries of the images done so far.
            done: True if all images are done.
        """
        content = {**self._common, "done": done, "images": list(entries)}
        write_text(self.path, json.dumps(content, indent=1) + "\n")

    def finished(self) -> tuple[int, list[Entry]]:
        """Return the number of finished shards, and their entries in the order of `names`."""
        read = [_read(self._path(number)) for number in range(1, self.shard.count + 1)]
        done = [c for c in read if c.get("done") and self._common.items() <= c.items()]
        entries = [entry for content in done for entry in content["images"]]
        positions = {name: number for number, name in enumerate(self.names)}

        def position(entry: Entry) -> int:
            name: str = entry["name"]
            return positions[name if name in positions else name.rpartition("/")[0]]

        return len(done), sorted(entries, key=position)

    @property
    def _common(self) -> dict[str, Any]:
        names = hashlib.sha256("\n".join(self.names).encode(errors="surrogateescape")).hexdigest()
        return {"shards": self.shard.count, "names": names, **self.settings}

    def _path(self, number: int) -> Path:
        return self.folder / f"{number}-of-{self.shard.count}.json"


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a shard's file; empty if it is missing or broken."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
