"""The files of a data set: their splits, and their problems, collected instead of raised."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from tangent_train.errors import DataError, SettingError

Split = Literal["train", "val", "test"]
"""A split of a data set."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""All splits, in order."""

# Sortable keys: names, or tuples of names and numbers.
_Group = TypeVar("_Group", bound="str | tuple[Any, ...]")

_UNREADABLE = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


class ImageFiles(NamedTuple):
    """The files of one panorama or photo.

    Attributes:
        name: Unique short name; ``/`` between groups.
        rgb: Color image.
        labels: File of class labels; None if the labels are distances.
        depth: Depth image, if depth is an input or the labels are distances.
        camera: File with the camera matrix, for photos with one file each.
    """

    name: str
    rgb: Path
    labels: Path | None = None
    depth: Path | None = None
    camera: Path | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the image."""
        return tuple(path for path in self[1:] if path is not None)


def draw_groups(
    groups: Iterable[_Group], fraction: float, seed: int | Sequence[int]
) -> set[_Group]:
    """Draw some of the groups; the draw depends on the seed, not on the order of the groups.

    Args:
        groups: All groups; repeated groups count once.
        fraction: Share of the groups to draw: at least one group and at most all but one; 0: none.
        seed: Seed of the draw.

    >>> sorted(draw_groups(["hall", "attic", "kitchen", "hall"], 0.5, seed=0))
    ['attic', 'kitchen']
    """
    ordered = sorted(set(groups))
    if len(ordered) < 2 or not fraction:
        return set()
    count = min(max(1, round(fraction * len(ordered))), len(ordered) - 1)
    order = np.random.default_rng(seed).permutation(len(ordered))
    return {ordered[place] for place in order[:count]}


class Problem(NamedTuple):
    """One problem of a data set.

    Attributes:
        file: File or folder.
        finding: The problem.
        remedy: The remedy; may be empty.
        item: Name of the unusable image or shape; None if the whole data set is unusable.
        error: Error with the same content.
    """

    file: str
    finding: str
    remedy: str
    item: str | None
    error: DataError | SettingError


class Problems:
    """Collects problems; safe to use from several threads.

    Attributes:
        warnings: Warnings about usable files.
        incomplete: Number of images found and published, "2 of 100", by split, if they differ.
    """

    def __init__(self) -> None:
        self._noted: list[Problem] = []
        self.warnings: list[str] = []
        self.incomplete: dict[str, str] = {}

    @contextmanager
    def noted(self, item: str | None = None, file: Path | None = None) -> Iterator[None]:
        """Return a context whose errors are noted, so that the check continues.

        Args:
            item: Name of the unusable item; None for the whole data set.
            file: Broken file, if the error does not name it first.
        """
        try:
            yield
        except _UNREADABLE as error:
            path = file if error.filename is None else Path(error.filename)
            expected = "a file or folder that can be read"
            self._add(DataError(path, found=error, expected=expected), item, file)
        except (DataError, SettingError) as error:
            self._add(error, item, file)

    def _add(self, error: DataError | SettingError, item: str | None, file: Path | None) -> None:
        where = error.subject if file is None or isinstance(error.subject, PurePath) else file
        finding = error.finding
        if error.found is not None and where is not error.subject:
            finding = f"{error.subject}: {finding}"
        self._noted.append(Problem(str(where), finding, error.remedy, item, error))

    def add_all(self, others: Problems) -> None:
        """Add the problems and warnings of another check."""
        self._noted += others._noted
        self.warnings += others.warnings

    def compare_counts(
        self, splits: Mapping[Split, Sequence[Any]], *published: Mapping[str, int]
    ) -> None:
        """Warn if the numbers of images of the splits are not published ones.

        Args:
            splits: Images of each split.
            published: Published numbers of images of these splits.
        """
        found = {str(split): len(images) for split, images in splits.items()}
        if found not in published:
            every = (found, *published)
            texts = [", ".join(f"{n} {split}" for split, n in counts.items()) for counts in every]
            self.warnings.append(f"found {texts[0]}; published are {' or '.join(texts[1:])}")
        for split, count in found.items():
            allowed = [numbers[split] for numbers in published]
            if count not in allowed:
                self.incomplete[split] = f"{count} of {' or '.join(map(str, allowed))}"

    def listed(self) -> list[Problem]:
        """Problems without duplicates, sorted by file."""
        once = {(problem.file, problem.finding): problem for problem in self._noted}
        return [once[key] for key in sorted(once)]

    @property
    def fatal(self) -> bool:
        """True if a problem concerns the whole data set."""
        return any(problem.item is None for problem in self._noted)

    @property
    def items(self) -> set[str]:
        """Names of unusable images or shapes."""
        return {p.item for p in self._noted if p.item is not None}

    def without(self, items: Iterable[Any]) -> list[Any]:
        """Return the usable images or shapes."""
        broken = self.items
        return [item for item in items if item.name not in broken]

    def refuse(self, root: object, remedy: str = "") -> None:
        """Raise the noted problems, if any.

        Args:
            root: Folder of the data set.
            remedy: Additional remedy for a list of problems.

        Raises:
            DataError: Lists all problems, or is the only one.
            SettingError: A setting fits none of the images.
        """
        listed = self.listed()
        if not listed:
            return
        error: Exception = listed[0].error
        if len(listed) > 1 and any(isinstance(problem.error, DataError) for problem in listed):
            lines = [f"{root}: found {len(listed)} problems; expected none."]
            lines += [f"  {problem.error}" for problem in listed]
            error = DataError("\n".join([*lines, remedy]).rstrip())
        raise error
