"""Problems of a data set, collected instead of raised one by one."""

from __future__ import annotations

import errno
import os
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from datamodules.core.cache import Files
    from datamodules.core.images import ImageFiles
    from datamodules.core.splits import Split


_Files = TypeVar("_Files", bound="Files")


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

        Raises:
            OSError: The disk is full.
        """
        try:
            yield
        except (DataError, SettingError) as error:
            self.add(error, item, file)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                raise
            path = file if error.filename is None else Path(os.fsdecode(error.filename))
            found = error if error.errno is None else os.strerror(error.errno)
            expected = "a file or folder that can be read"
            self.add(DataError(path, found=found, expected=expected), item, file)

    def add(
        self, error: DataError | SettingError, item: str | None = None, file: Path | None = None
    ) -> None:
        """Note an error, see `noted`."""
        where = error.subject if file is None or isinstance(error.subject, PurePath) else file
        finding = error.finding
        if error.found is not None and where is not error.subject:
            finding = f"{error.subject}: {finding}"
        self._noted.append(Problem(str(where), finding, error.remedy, item, error))

    def add_all(self, others: Problems) -> None:
        """Add the problems of another check."""
        self._noted += others._noted

    def compare_counts(
        self, splits: Mapping[Split, Sequence[Files]], *published: Mapping[str, int]
    ) -> None:
        """Warn if the numbers of images of the splits are not published ones.

        Args:
            splits: Images of each split.
            published: Published numbers of images of these splits.
        """
        found = {str(split): len(images) for split, images in splits.items()}
        if not any(found == numbers for numbers in published):
            counts, *others = (
                ", ".join(f"{count} {split}" for split, count in numbers.items())
                for numbers in (found, *published)
            )
            self.warnings.append(f"found {counts}; published are {' or '.join(others)}")
        for split, count in found.items():
            allowed = [numbers[split] for numbers in published]
            if count not in allowed:
                self.incomplete[split] = f"{count} of {' or '.join(map(str, allowed))}"

    def note_strays(self, labels: Iterable[Path], images: Iterable[ImageFiles]) -> None:
        """Warn of label images that belong to none of the images."""
        strays = set(labels) - {image.labels for image in images}
        self.note_absent("label images", map(str, strays))

    def note_absent(self, source: str, names: Iterable[str]) -> None:
        """Warn of names in a list or folder that belong to no image."""
        shown = sorted(repr(name)[1:-1] for name in names)
        if shown:
            self.warnings.append(f"{source}: {len(shown)} without an image, e.g. {shown[0]}")

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

    def without(self, items: Iterable[_Files]) -> list[_Files]:
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
        if len(listed) == 1 or all(isinstance(problem.error, SettingError) for problem in listed):
            raise listed[0].error
        lines = [f"{root}: found {len(listed)} problems; expected none."]
        lines += [f"  {problem.error}" for problem in listed]
        raise DataError("\n".join([*lines, remedy]).rstrip())
