"""Images and videos that a command reads, and work on one after the other."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, printable
from tangent_train.io.gpano import Eye, eye_part, shape_of
from tangent_train.io.image_files import VIDEO_SUFFIXES, input_paths, short_names
from tangent_train.io.videos import (
    Frame,
    read_frames,
    read_video_size,
    read_video_tags,
)
from tangent_train.progress import progress_bar
from tangent_train.threads import in_threads

_AHEAD = min(4, os.cpu_count() or 1)
"""Largest number of images that are read ahead, and that wait to be written, in memory."""


@dataclass(frozen=True)
class Job:
    """Work on one image, or on one frame of a video.

    Attributes:
        name: Unique name, a path without suffix; that of a frame is ``<video>/000012``.
        path: File of the image or video.
        value: Input of the next step, at first the function that decodes a frame, or None; after
            the last step, the result.
        place: Number of a frame in its video, and its time in seconds once it is decoded.
        error: Message of a failed step; empty if all succeeded.
    """

    name: str
    path: Path
    value: Any = None
    error: str = ""
    place: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_frame(self) -> bool:
        """True for a frame of a video."""
        return self.path.suffix.lower() in VIDEO_SUFFIXES

    def then(self, step: Callable[[Job], Any]) -> Job:
        """Return the job after its next step; after an error, the step is skipped."""
        if self.error:
            return self
        try:
            return replace(self, value=step(self))
        except (DataError, SettingError, MemoryError) as error:
            message = str(error) if str(self.path) in str(error) else f"{self.path}: {error}"
            return replace(self, value=None, error=message)


@dataclass(frozen=True)
class Video:
    """A video with its size.

    Attributes:
        path: File of the video.
        size: Number of frames, and rows and columns that are used of a frame.
        frames: Names of the frames that are used, with their numbers in the video.
        part: Rows and columns of a frame that are used, see `eye_part`.
    """

    path: Path
    size: tuple[int, int, int]
    frames: dict[str, int]
    part: tuple[slice, slice]


@dataclass(frozen=True)
class Inputs:
    """Images and videos of a command.

    Attributes:
        images: Files of the images by name.
        videos: Videos by name.
        broken: Jobs of the videos that cannot be read, by name.
        every: Step between the frames of a video.
    """

    images: dict[str, Path]
    videos: dict[str, Video]
    broken: dict[str, Job]
    every: int

    @classmethod
    def find(
        cls,
        pattern: str | Path,
        every: int = 1,
        eye: Eye | None = None,
        angles: Sequence[float] | None = None,
    ) -> Inputs:
        """Find images and videos, see `image_paths`.

        Folders below the given one that a command wrote are skipped.

        Args:
            pattern: A file, a folder, or a pattern.
            every: Step between the frames of a video: the first and then every n-th one.
            eye: See `eye_part`, for videos.
            angles: See `eye_part`, for videos.

        Raises:
            DataError: There are no images and videos.
        """
        paths = input_paths(pattern, print_text)
        inputs = cls({}, {}, {}, every)
        for short, path in zip(short_names(paths, pattern), paths, strict=True):
            if path.suffix.lower() not in VIDEO_SUFFIXES:
                inputs.images[short] = path
                continue
            # The frames get a folder, which may also be one of images.
            name = short + path.suffix if path.with_suffix("").is_dir() else short
            job = Job(name, path).then(lambda job: _sized(job.path, eye, angles))
            if job.error:
                inputs.broken[name] = job
            else:
                size, part = job.value
                frames = {f"{name}/{n:06d}": n for n in range(0, size[0], every)}
                inputs.videos[name] = Video(path, size, frames, part)
        return inputs

    @property
    def names(self) -> list[str]:
        """Names of all images, frames and unreadable videos."""
        frames = [name for video in self.videos.values() for name in video.frames]
        return [*self.images, *frames, *self.broken]

    def jobs(self, names: Collection[str]) -> Iterator[Job]:
        """Yield the jobs of some images and frames, in the order of `names` of the inputs."""
        wanted = set(names)
        yield from (Job(name, path) for name, path in self.images.items() if name in wanted)
        for video in self.videos.values():
            if wanted.intersection(video.frames):
                yield from self._frames(video, wanted)
        yield from (job for name, job in self.broken.items() if name in wanted)

    def _frames(self, video: Video, wanted: set[str]) -> Iterator[Job]:
        """Decode a video up to the last wanted frame; after damage, the other frames fail."""
        frames = read_frames(video.path, video.size[0], self.every, video.part)
        last = max(number for name, number in video.frames.items() if name in wanted)
        error = ""
        for name, number in video.frames.items():
            frame: Frame | None = None
            place: dict[str, float] = {"frame": number}
            if number <= last and not error:
                try:
                    frame = next(frames)
                    place["time_s"] = round(frame.time_s, 6)
                except DataError as damage:
                    error = str(damage)
            if name in wanted:
                yield Job(name, video.path, frame, error, place)


def _sized(
    path: Path, eye: Eye | None, angles: Sequence[float] | None
) -> tuple[tuple[int, int, int], tuple[slice, slice]]:
    """Return the size of a video and the part of its frames that one eye sees, see `Video`."""
    count, *size = read_video_size(path)
    shape = size[0], size[1]
    part = eye_part(path, shape, eye, angles, read_video_tags(path))
    return (count, *shape_of(shape, part)), part


def work_on(
    description: str,
    jobs: Iterable[Job],
    count: int,
    work: Callable[[Job, Callable[[float], object]], Any],
    read: Callable[[Job], Any] | None = None,
    write: Callable[[Job], Any] | None = None,
) -> Generator[Job]:
    """Work on images one after the other; print progress, time left, and errors.

    An error in one image does not stop the others.

    Args:
        description: Label of the progress bar.
        jobs: Jobs of the images.
        count: Number of jobs.
        work: Step in this thread. It takes a job, and a function to call with the share of the
            work done since the last call.
        read: Step before it, in other threads.
        write: Step after it, in other threads.

    Yields:
        Finished jobs in order.
    """
    with progress_bar() as bar:
        task = bar.add_task(description, total=count, unit="", before=0, rate="")
        progress = partial(bar.advance, task)

        def worked() -> Iterator[Job]:
            for number, job in enumerate(_in_threads(read, jobs), start=1):
                yield job.then(lambda job: work(job, progress))
                bar.update(task, completed=number)

        for job in _in_threads(write, worked()):
            if job.error:
                bar.console.print(printable(job.error), style="red", markup=False, soft_wrap=True)
            yield job


def _in_threads(step: Callable[[Job], Any] | None, jobs: Iterable[Job]) -> Iterable[Job]:
    if step is None:
        return jobs
    return in_threads(lambda job: job.then(step), jobs, _AHEAD, _AHEAD)
