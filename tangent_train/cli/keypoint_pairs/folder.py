"""Results of tangent-keypoints: nothing foreign is touched, finished pairs are kept."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tangent_train.errors import SettingError
from tangent_train.files import write_text
from tangent_train.json_text import parse_json
from tangent_train.results.keypoints.entries import PairEntry
from tangent_train.results.keypoints.tables import pairs_csv

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from tangent_train.results.keypoints.tables import KeypointReport

__all__ = ["EXPORT", "PICTURES", "ResultsFolder"]

RESULTS = "results.json"
PICTURES = "matches"
EXPORT = "export"
_TABLES = ("pairs.csv", "keypoints.md")
_PROGRAM = "tangent-keypoints"
_VERSION = 1


@dataclass(frozen=True)
class ResultsFolder:
    """Where results go.

    Attributes:
        path: The folder.
        deciding: The settings that figures depend on.
    """

    path: Path
    deciding: Mapping[str, Any]

    def open(self, *, overwrite: bool) -> dict[str, PairEntry]:
        """Make sure that the folder is ours to write to, before any work.

        Args:
            overwrite: Whether earlier results are thrown away.

        Returns:
            What is known of the pairs that are done already, by name.

        Raises:
            SettingError: The folder holds something else, or results of other settings.
        """
        self._check_place()
        found = self._read()
        entries = [entry for entry in found[1] if entry.error is None] if found else []
        if found is None or not entries or overwrite:  # without a finished pair nothing is lost
            self._clear()
            self.write(())
            return {}
        before = found[0]
        differing = [k for k, value in self._plain().items() if before.get(k) != value]
        if differing:
            name = differing[0]
            raise SettingError(
                name,
                found=self._plain()[name],
                expected=f"{before.get(name)}, as for the results in {self.path}",
                remedy="Give another output, or overwrite=true to throw them away.",
            )
        return {entry.name: entry for entry in entries}

    def write(self, entries: Iterable[PairEntry]) -> None:
        """Write ``results.json``."""
        content = {
            "program": _PROGRAM,
            "version": _VERSION,
            "settings": self._plain(),
            "pairs": [entry.as_dict() for entry in entries],
        }
        text = json.dumps(content, indent=1, ensure_ascii=False)
        try:
            write_text(self.path / RESULTS, text + "\n")
        except OSError as error:
            raise SettingError(
                "output", found=error, expected="a folder that can be written, with room"
            ) from error

    def write_tables(self, report: KeypointReport) -> None:
        """Write ``pairs.csv`` and ``keypoints.md``."""
        write_text(self.path / "pairs.csv", pairs_csv(report.entries, report.published))
        write_text(self.path / "keypoints.md", report.markdown())

    def picture(self, index: int, name: str, condition: str) -> Path:
        """The file of a picture of a pair's matches."""
        return self.path / PICTURES / f"{index:03}_{file_name(name)}_{condition}.png"

    def _plain(self) -> dict[str, Any]:
        """The settings as JSON gives them back."""
        plain: dict[str, Any] = json.loads(json.dumps(self.deciding))
        return plain

    def _check_place(self) -> None:
        place = next(p for p in (self.path, *self.path.absolute().parents) if p.exists())
        if not place.is_dir() or not os.access(place, os.W_OK):
            found = f"the file {place}" if place.is_file() else str(place)
            raise SettingError("output", found=found, expected="a folder that can be written")

    def _read(self) -> tuple[dict[str, Any], list[PairEntry]] | None:
        """Settings and entries of earlier results; None of a new or empty folder."""
        names = sorted(p.name for p in self.path.iterdir()) if self.path.is_dir() else []
        if not [name for name in names if not name.startswith(".")]:
            return None
        try:
            content = parse_json((self.path / RESULTS).read_bytes())
            if (content["program"], content["version"]) == (_PROGRAM, _VERSION):
                return content["settings"], [PairEntry.of(plain) for plain in content["pairs"]]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            pass
        raise SettingError(
            "output",
            found=f"{self.path} with other files ({names[0]}, …)",
            expected="a new or empty folder, or one with results of this command",
            remedy="Give another folder.",
        )

    def _clear(self) -> None:
        """Remove what earlier results consist of; called only of folders of ours."""
        for name in (RESULTS, *_TABLES):
            (self.path / name).unlink(missing_ok=True)
        for name in (PICTURES, EXPORT):
            if (self.path / name).is_dir():
                shutil.rmtree(self.path / name)


def file_name(name: str) -> str:
    """A name of a pair as part of the name of a file, at most 80 characters.

    >>> file_name("hall/a – hall/b")
    'hall_a_hall_b'
    """
    return re.sub(r"[^\w.-]+", "_", name).strip("_.")[:80] or "pair"
