"""The prepared store: panoramas decoded once, then read only where a sample looks.

A store is a folder. In it, every size and mask of the panoramas has a folder of its own, and every
panorama one file (see `store_files`), named as in the data set. A file remembers the names, sizes
and times of the files it was made from and the settings; it is made anew when they change, or when
it is broken. One made with depth also serves runs without.
"""

from __future__ import annotations

import os
import shutil
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from datamodules.core.panoramas import Panorama
from datamodules.core.problems import Problems
from datamodules.core.progress import show_progress
from datamodules.core.sources import in_threads, read_strictly
from datamodules.core.store_files import PAGE, StoredPanorama, broken, open_stored, write_stored
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from datamodules.core.panoramas import FileSource

__all__ = ["PreparedPanoramas", "prepare_store"]

_SUFFIX = ".panorama"
_SKIP = "data.skip_broken=true leaves out what is broken."
_BYTES_PER_PIXEL = {"rgb": 3, "labels": 1, "depth": 2}


class PreparedPanoramas:
    """The panoramas of another source, from a prepared store.

    The arrays are read-only views of the files. The first time a process opens a file it checks all
    of the content and that the source is the one it was made from; later, header and size.

    Args:
        source: Where they come from.
        store: Folder of the store.
    """

    def __init__(self, source: FileSource, store: str | Path) -> None:
        self._source = source
        self._folder = Path(store) / source.variant
        self._checked: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._source)

    def name(self, index: int) -> str:
        """The name in the source."""
        return self._source.name(index)

    def path(self, index: int) -> Path:
        """The file of one panorama."""
        return self._folder / (self._source.name(index) + _SUFFIX)

    def nbytes(self, index: int) -> int:
        """Size of the file of one panorama; a header longer than a page adds to it."""
        height, width = self._source.shape
        parts = [_BYTES_PER_PIXEL[part] * height * width for part in self._source.files(index)]
        return PAGE + sum(part + -part % PAGE for part in parts)

    def read(self, index: int) -> Panorama:
        """One panorama.

        Raises:
            DataError: It is not prepared, is broken, or was made from other files or settings.
        """
        stored = open_stored(self.path(index))
        if self._checked.get(index) != stored.checksum:  # the first time, or made anew meanwhile
            stored = self.checked(index, content=True)
            self._checked[index] = stored.checksum
        with_depth = "depth" in self._source.files(index)
        return stored.panorama if with_depth else stored.panorama._replace(depth=None)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one panorama, ``(256,)``; no pixel is read.

        Raises:
            DataError: It is not prepared, is broken, or was made from other files or settings.
        """
        return self.checked(index, content=False).label_counts

    def checked(self, index: int, *, content: bool) -> StoredPanorama:
        """Open a panorama and make sure that it is of this source.

        Args:
            index: Which.
            content: Whether to read it all, too.

        Raises:
            DataError: It is not prepared, is broken, or was made from other files or settings.
        """
        stored = open_stored(self.path(index))
        wanted, found = _flat(self._made_from(index)), _flat(stored.made_from)
        others = sorted(name for name in wanted if found.get(name) != wanted[name])
        if others:
            raise broken(
                stored.path,
                "made from " + ", ".join(f"{name} {found.get(name, 'nothing')}" for name in others),
                ", ".join(f"{name} {wanted[name]}" for name in others),
            )
        if content:
            stored.check_content()
        return stored

    def make(self, index: int) -> None:
        """Decode one panorama and write its file.

        Raises:
            DataError: A file of the source is broken.
        """
        # Asked before the files are read: files changed meanwhile are noticed later.
        made_from = self._made_from(index)
        write_stored(self.path(index), read_strictly(self._source, index), made_from)

    def _made_from(self, index: int) -> dict[str, dict[str, str]]:
        files = {}
        for part, path in self._source.files(index).items():
            status = path.stat()
            files[part] = f"{path.name} ({status.st_size} bytes of {status.st_mtime_ns} ns)"
        return {"files": files, "settings": dict(self._source.settings)}


def _flat(made_from: dict[str, dict[str, str]]) -> dict[str, str]:
    return {name: value for group in made_from.values() for name, value in group.items()}


def prepare_store(
    splits: Sequence[PreparedPanoramas],
    *,
    whole: Sequence[PreparedPanoramas] = (),
    progress: bool = True,
) -> int:
    """Make the files that are missing, broken or out of date, on all cores.

    An interrupt leaves whole files only; the next call goes on.

    Args:
        splits: What to make.
        whole: Those of them whose files are read, for damage that header and size do not show.
        progress: Whether to show progress bars.

    Returns:
        How many were made.

    Raises:
        DataError: The disk is too full, before anything is written; or files of the source are
            broken, which are named after all others are made.
    """
    wanted = [(split, index) for split in splits for index in range(len(split))]
    lacking: set[int] = set()

    def check(place: int) -> None:
        split, index = wanted[place]
        try:
            split.checked(index, content=split in whole)
        except DataError:
            lacking.add(place)

    _follow(check, "Checking the store", len(wanted), show=progress and bool(whole))
    missing = [wanted[place] for place in sorted(lacking)]

    problems = Problems()

    def make(place: int) -> None:
        split, index = missing[place]
        try:
            split.make(index)
        except DataError as error:  # of one file; a disk that is full stops all
            problems.add(error, place)

    if missing:
        _check_disk(missing)
        before = len(wanted) - len(missing)
        _follow(make, "Preparing panoramas", len(missing), before=before, show=progress)
        problems.refuse("data.store", left=before, more=_SKIP)
    return len(missing)


def _follow(
    work: Callable[[int], None], description: str, count: int, *, show: bool, before: int = 0
) -> None:
    with closing(in_threads(work, count)) as done:  # closed: an interrupt drops what is queued
        show_progress(done, description, "panoramas", before + count, before=before, show=show)


def _check_disk(missing: Iterable[tuple[PreparedPanoramas, int]]) -> None:
    files = [(split.path(index), split.nbytes(index)) for split, index in missing]
    folder = next(parent for parent in files[0][0].absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        kind = "a folder that may not be written to" if folder.is_dir() else "a file"
        raise DataError(folder, found=kind, expected="a folder for data.store")
    needed, free = sum(size for _, size in files), shutil.disk_usage(folder).free
    if needed > free:
        raise DataError(
            "data.store",
            found=f"{free / 1e9:.1f} GB free in {folder}",
            expected=f"{needed / 1e9:.1f} GB for {len(files)} panoramas",
            remedy="Free some space or name a folder on another disk; nothing was written.",
        )
