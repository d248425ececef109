"""What is wrong with a data set: every problem there is, not only the first."""

from __future__ import annotations

import os
import re
from contextlib import contextmanager, nullcontext
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator
    from contextlib import AbstractContextManager

__all__ = ["Noted", "Problem", "Problems", "raised"]

_Item = TypeVar("_Item")
_ERROR_NUMBER = re.compile(r"\[Errno \d+\] ")


class Noted(Protocol):
    """Makes blocks whose errors are noted; `raised` lets them through."""

    def __call__(
        self, item: Hashable | None = None, file: Path | None = None, /
    ) -> AbstractContextManager[None]:
        """See `Problems.noted`."""
        ...


def raised(
    item: Hashable | None = None, file: Path | None = None, /
) -> AbstractContextManager[None]:
    """A block whose errors are raised: the first one ends the search."""
    del item, file
    return nullcontext()


class Problem(NamedTuple):
    """One thing that is wrong.

    Attributes:
        item: What is left out if broken images are; None where nothing can go on without it.
        file: File or folder, or a setting.
        finding: What is wrong with it.
        remedy: What to do about it; may be empty.
        error: The error that says all this.
    """

    item: Hashable | None
    file: str
    finding: str
    remedy: str
    error: DataError | SettingError


class Problems:
    """Collects problems; several threads may do so at once."""

    def __init__(self) -> None:
        self._noted: list[Problem] = []

    @contextmanager
    def noted(self, item: Hashable | None = None, file: Path | None = None, /) -> Iterator[None]:
        """A block after whose errors the search goes on.

        Args:
            item: What cannot be used then; None for all of the data set.
            file: What is wrong then, if the error does not name it first.
        """
        try:
            yield
        except (DataError, SettingError) as error:
            self.add(error, item, file)
        except OSError as error:
            path = file if error.filename is None else Path(os.fsdecode(error.filename))
            found = error if error.errno is None else os.strerror(error.errno)
            expected = "a file or folder that can be read"
            self.add(DataError(path, found=found, expected=expected), item, file)

    def add(
        self,
        error: DataError | SettingError,
        item: Hashable | None = None,
        file: Path | None = None,
    ) -> None:
        """Note an error, see `noted`."""
        # What names no file first, as a setting that does not suit one, is said beside that file.
        where = error.subject if file is None or isinstance(error.subject, PurePath) else file
        self._noted.append(Problem(item, str(where), _finding(error, where), error.remedy, error))

    def add_all(self, others: Problems) -> None:
        """Take over what another search has noted."""
        self._noted += others._noted

    def listed(self) -> list[Problem]:
        """All of them, each once, by file."""
        once = {(problem.file, problem.finding): problem for problem in self._noted}
        return sorted(once.values(), key=lambda problem: (problem.file, problem.finding))

    def __len__(self) -> int:
        return len(self.listed())

    @property
    def fatal(self) -> bool:
        """Whether one of them concerns all of the data set."""
        return any(problem.item is None for problem in self._noted)

    @property
    def items(self) -> set[Hashable]:
        """What cannot be used."""
        return {problem.item for problem in self._noted if problem.item is not None}

    def without(self, items: Iterable[_Item]) -> list[_Item]:
        """Those that can be used."""
        broken = self.items
        return [item for item in items if item not in broken]

    def refuse(self, root: object, *, left: int, more: str = "") -> None:
        """Raise what was noted, if anything.

        Args:
            root: The data set.
            left: How many images can be used.
            more: What else to do about it.

        Raises:
            DataError: One problem, or a list of all.
            SettingError: One problem with a setting, alone or with every image.
        """
        listed = self.listed()
        if not listed:
            return
        of_setting = all(isinstance(problem.error, SettingError) for problem in listed)
        if len(listed) == 1 or (of_setting and not left):
            raise listed[0].error
        lines = [f"{root}: found {len(listed)} problems; expected none."]
        lines += [f"  {problem.error}" for problem in listed]
        raise DataError("\n".join([*lines, more]).rstrip())


def _finding(error: DataError | SettingError, where: object) -> str:
    """What an error says, without the file, which stands beside it."""
    if error.found is None:
        text = str(error).removeprefix(str(where)).lstrip(",: ")
    else:
        setting = f"{error.subject} " if isinstance(error, SettingError) else ""
        text = f"{setting}{error.found}; expected {error.expected}"
    text = text.replace(f": '{where}'", "").replace(f" of {where}", "")
    return _ERROR_NUMBER.sub("", text)
