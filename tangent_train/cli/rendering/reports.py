"""What ``tangent-render`` says: what it refuses to overwrite, and what did not work."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

__all__ = ["Failures", "refuse_existing", "say"]


def say(text: str) -> None:
    """Print a line; paths in it stay whole, whatever characters they have."""
    Console(highlight=False).print(text, soft_wrap=True, markup=False)


def refuse_existing(paths: Sequence[Path]) -> None:
    """Refuse to write over files, and into folders that hold something.

    Raises:
        SettingError: There is one.
    """
    there = [p for p in paths if (any(p.iterdir()) if p.is_dir() else p.exists())]
    if there:
        more = f" (and {len(there) - 1} more)" if len(there) > 1 else ""
        raise SettingError(
            "output",
            found=f"{there[0]}{more}, which exists",
            expected="nothing there yet",
            remedy="Choose another output, or overwrite=true.",
        )


class Failures:
    """Errors of single panoramas, kept until the others are done.

    Args:
        what: What can fail.
        total: How many there are.
    """

    def __init__(self, what: str, total: int) -> None:
        self._what = what
        self._total = total
        self._errors: list[Exception] = []

    def __len__(self) -> int:
        return len(self._errors)

    @contextmanager
    def kept(self, path: Path) -> Iterator[None]:
        """Keep what the block raises because of files or settings.

        Args:
            path: Named in errors that do not name it.
        """
        try:
            yield
        except (DataError, SettingError, OSError) as error:
            named = str(path) in str(error)
            self._errors.append(error if named else DataError(f"{path}: {error}"))

    def report(self) -> None:
        """Raise one error for all.

        Raises:
            DataError: There were some.
        """
        if not self._errors:
            return
        if self._total == 1:
            raise DataError(str(self._errors[0])) from self._errors[0]
        lines = "".join(f"\n  {error}" for error in self._errors)
        raise DataError(f"{len(self)} of {self._total} {self._what}s could not be rendered:{lines}")
