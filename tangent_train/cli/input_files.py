"""Input of ``tangent-predict`` and ``tangent-render``: images, and the frames of videos."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from datamodules.images.image_files import IMAGE_SUFFIXES, image_paths, short_names
from datamodules.images.videos import VIDEO_SUFFIXES, read_frames, read_video_size
from tangent_train.cli.command_settings import InputSettings
from tangent_train.cli.jobs import Job, Shard
from tangent_train.console import print_text
from tangent_train.errors import DataError, at_least
from tangent_train.results.predictions import frame_name


def is_video(path: Path) -> bool:
    """True if the suffix of a file is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


@dataclass(frozen=True)
class Inputs:
    """Images and videos by name.

    Attributes:
        files: All files, sorted.
        videos: Jobs of the videos among them: the number of frames, rows
            and columns, or an error.
        every: See `InputSettings`.
    """

    files: dict[str, Path]
    videos: dict[str, Job]
    every: int

    @classmethod
    def find(
        cls,
        settings: InputSettings,
        is_result: Callable[[Path], bool],
        check_size: Callable[[Path, tuple[int, int]], object],
    ) -> Inputs:
        """The files that settings name, without results of this command.

        Args:
            settings: Settings of the command.
            is_result: True for files that the command wrote.
            check_size: Refuses videos by their rows and columns.

        Raises:
            DataError: There are none, or only results.
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
            # A folder of images may have the name of a video, whose frames get a folder too.
            name + path.suffix if is_video(path) and path.with_suffix("").is_dir() else name: path
            for name, path in zip(short_names(paths), paths, strict=True)
        }
        videos = {name: Job(name, path) for name, path in files.items() if is_video(path)}
        return cls(files, {name: job.then(size) for name, job in videos.items()}, every)

    def part(self, shard: Shard) -> Inputs:
        """Return the inputs of a shard; a video is not divided."""
        names = shard.part(list(self.files))
        files = {name: self.files[name] for name in names}
        videos = {name: job for name, job in self.videos.items() if name in files}
        return Inputs(files, videos, self.every)

    def names(self) -> list[str]:
        """Names of all images and frames; a video that cannot be read is one."""
        names = []
        for name in self.files:
            video = self.videos.get(name)
            names += [name] if video is None or video.error else self._frame_names(video)
        return names

    def missing(self, done: Container[str]) -> Iterator[Job]:
        """Images, and frames with what gives their pixels, that are not done yet."""
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
