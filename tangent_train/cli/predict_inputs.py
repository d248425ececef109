"""What ``tangent-predict`` labels: images, and the frames of videos."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from datamodules.images.image_files import IMAGE_SUFFIXES, image_paths, short_names
from datamodules.images.videos import VIDEO_SUFFIXES, read_frames, read_video_size
from tangent_train.cli.each import Job, Shard
from tangent_train.errors import DataError, SettingError
from tangent_train.results.predictions import frame_name


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES


@dataclass(frozen=True)
class Inputs:
    """Images and videos by name.

    Attributes:
        files: All files, sorted.
        videos: Jobs of the videos among them: the number of frames, or an error.
    """

    files: dict[str, Path]
    videos: dict[str, Job]

    @classmethod
    def find(
        cls,
        pattern: str | Path,
        output: Path,
        check_size: Callable[[Path, tuple[int, int]], object],
    ) -> Inputs:
        """The files that a setting names, without results of this command.

        Args:
            pattern: See `image_paths`.
            output: Where results are.
            check_size: Refuses videos by their rows and columns.

        Raises:
            DataError: There are none.
            SettingError: There are only results.
        """
        results = [(output / kind).resolve() for kind in ("labels", "color", "overlay")]
        paths = [
            path
            for path in image_paths(pattern, suffixes=(*IMAGE_SUFFIXES, *VIDEO_SUFFIXES))
            if not any(path.resolve().is_relative_to(folder) for folder in results)
        ]
        if not paths:
            raise SettingError("input", found=f"only results in {output}", expected="images")

        def frames(job: Job) -> int:
            count, rows, columns = read_video_size(job.path)
            check_size(job.path, (rows, columns))
            return count

        files = {
            # A folder of images may have the name of a video, whose frames get a folder too.
            name + path.suffix if is_video(path) and path.with_suffix("").is_dir() else name: path
            for name, path in zip(short_names(paths), paths, strict=True)
        }
        videos = {name: Job(name, path) for name, path in files.items() if is_video(path)}
        return cls(files, {name: job.then(frames) for name, job in videos.items()})

    def part(self, shard: Shard) -> Inputs:
        """Those of a shard; a video is not divided."""
        names = shard.part(list(self.files))
        files = {name: self.files[name] for name in names}
        return Inputs(files, {name: job for name, job in self.videos.items() if name in files})

    def names(self) -> list[str]:
        """Names of all images and frames; a video that cannot be read is one."""
        names = []
        for name in self.files:
            video = self.videos.get(name)
            count = video.value or 0 if video else 0
            names += [frame_name(name, number) for number in range(count)] or [name]
        return names

    def missing(self, done: Container[str]) -> Iterator[Job]:
        """Images, and frames with what gives their pixels, that are not done yet."""
        for name, path in self.files.items():
            if name in self.videos:
                yield from self._frames(self.videos[name], done)
            elif name not in done:
                yield Job(name, path)

    def _frames(self, video: Job, done: Container[str]) -> Iterator[Job]:
        if video.error:
            yield video
            return
        if all(frame_name(video.item, number) in done for number in range(video.value)):
            return
        number = -1
        try:
            for number, frame in enumerate(read_frames(video.path)):
                if (name := frame_name(video.item, number)) not in done:
                    yield Job(name, video.path, frame)
        except DataError as error:
            yield Job(frame_name(video.item, number + 1), video.path, error=str(error))
