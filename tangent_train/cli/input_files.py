"""Find the images and videos that ``tangent-predict`` and ``tangent-render`` read."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from tangent_train.cli.jobs import Job, Shard
from tangent_train.config.settings import ImageSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, at_least
from tangent_train.io.image_files import IMAGE_SUFFIXES, image_paths, short_names
from tangent_train.io.videos import VIDEO_SUFFIXES, read_frames, read_video_size
from tangent_train.results.predictions import frame_name


def is_video(path: Path) -> bool:
    """Return True if a file has the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


@dataclass(frozen=True)
class Inputs:
    """Images and videos by name.

    Attributes:
        files: Files of all images and videos, sorted.
        videos: Jobs of the videos; their value is the number of frames, rows and columns.
        every: Step between frames, see `ImageSettings`.
    """

    files: dict[str, Path]
    videos: dict[str, Job]
    every: int

    @classmethod
    def find(
        cls,
        settings: ImageSettings,
        is_result: Callable[[Path], bool],
        check_size: Callable[[Path, tuple[int, int]], object],
    ) -> Inputs:
        """Find the files that settings name, without results of this command.

        Args:
            settings: Settings of the command.
            is_result: Function that returns True for a file that the command wrote.
            check_size: Function that takes a file with its rows and columns, and may refuse them.

        Raises:
            DataError: No files are found, or only results.
            SettingError: `every` is invalid.
        """
        every = at_least("every", settings.every, 1)
        suffixes = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
        paths = image_paths(settings.input or "", suffixes, is_result, print_text)

        def size(job: Job) -> tuple[int, int, int]:
            frames, rows, columns = read_video_size(job.path)
            check_size(job.path, (rows, columns))
            return frames, rows, columns

        files = {
            # Frames get a folder with the name of their video, which may also be one of images.
            name + path.suffix if is_video(path) and path.with_suffix("").is_dir() else name: path
            for name, path in zip(short_names(paths, settings.input or ""), paths, strict=True)
        }
        videos = {name: Job(name, path) for name, path in files.items() if is_video(path)}
        return cls(files, {name: job.then(size) for name, job in videos.items()}, every)

    def part(self, shard: Shard) -> Inputs:
        """Return the inputs of a shard; videos are not divided."""
        names = shard.part(list(self.files))
        files = {name: self.files[name] for name in names}
        videos = {name: job for name, job in self.videos.items() if name in files}
        return Inputs(files, videos, self.every)

    def names(self) -> list[str]:
        """Return the names of all images and frames; an unreadable video counts as one."""
        names = []
        for name in self.files:
            video = self.videos.get(name)
            names += [name] if video is None or video.error else self._frame_names(video)
        return names

    def missing(self, done: Container[str]) -> Iterator[Job]:
        """Yield jobs for images and frames that are not done; frames have a pixel reader as value.

        Args:
            done: Names of images and frames that are done.
        """
        for name, path in self.files.items():
            if name in self.videos:
                yield from self._frames(self.videos[name], done)
            elif name not in done:
                yield Job(name, path)

    def _frame_names(self, video: Job) -> list[str]:
        return [frame_name(video.item, n) for n in range(0, video.value[0], self.every)]

    def _frames(self, video: Job, done: Container[str]) -> Iterator[Job]:
        if video.error:
            yield video
            return
        missing = {name for name in self._frame_names(video) if name not in done}
        number = 0
        try:
            for frame in read_frames(video.path, video.value[0], self.every) if missing else ():
                if (name := frame_name(video.item, number)) in missing:
                    missing.remove(name)
                    yield Job(name, video.path, frame)
                elif not missing:
                    return
                number += self.every
        except DataError as error:
            yield Job(frame_name(video.item, number), video.path, error=str(error))
