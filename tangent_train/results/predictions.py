"""Write the files of predictions: pixels, pictures, a summary and a report page."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datamodules.core.label_map import UNKNOWN_NAME
from tangent_train.errors import SettingError, counted
from tangent_train.files import csv_text, write_text
from tangent_train.io.image_files import composed
from tangent_train.io.videos import write_video
from tangent_train.results.html import EncodedImage, encode_image, write_report
from tangent_train.results.tables import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from tangent_train.heads.base import Head, Painter, PredictedImage

_SUMMARY = "summary.json"
_FILES = (_SUMMARY, "classes.json", "summary.csv", "report.html", "shards")
_PICTURES = ("color", "overlay")  # of the frames of a video: videos
_NAMES = (*_FILES, "labels", "color", "overlay", "probabilities", "depth", "points")

Entry = dict[str, Any]
"""Entry of an image: file, name, rows, columns and its summary, or file, name and error."""


def frame_name(video: str, number: int) -> str:
    """Return the name of a video's frame, e.g. ``walk/000012``; numbers start at 0."""
    return f"{video}/{number:06d}"


def is_result_in(output: Path) -> Callable[[Path], bool]:
    """Return a function that is True for files of predictions.

    Args:
        output: Folder of predictions. Others are recognized by their summary.
    """
    output = output.resolve()

    def is_result(path: Path) -> bool:
        path = path.resolve()
        named = [folder for folder in path.parents if path.relative_to(folder).parts[0] in _NAMES]
        return any(folder == output or (folder / _SUMMARY).is_file() for folder in named)

    return is_result


def encode_prediction(head: Head, name: str, predicted: PredictedImage) -> EncodedImage:
    """Compress an image for the report, to 0.1 to a few megabytes."""
    image, pixels, _ = predicted
    return encode_image(
        name,
        image.rgb,
        len(head.class_names),
        prediction=pixels if image.area is None else image.area.place(pixels),
        is_metric=head.is_metric,
        camera_matrix=image.camera_matrix,
        sphere=image.camera_matrix is None,
    )


@dataclass(frozen=True)
class PredictionFolder:
    """Output folder of predictions.

    Attributes:
        path: Folder.
        head: Formats of the files.
        kinds: Kinds of output to write.
    """

    path: Path
    head: Head
    kinds: Sequence[str]

    def files(self, name: str) -> dict[str, Path]:
        """Return the files of one image by kind."""
        suffixes = self.head.suffixes
        return {kind: self.path / kind / f"{name}{suffixes[kind]}" for kind in self.kinds}

    def check(self, *, resume: bool) -> None:
        """Refuse a folder with earlier results.

        Args:
            resume: True if earlier results were to be continued, but have no summary.

        Raises:
            SettingError: The folder has earlier results.
        """
        names = (*self.head.suffixes, *_FILES)
        existing = [path for name in names if (path := self.path / name).exists()]
        if existing:
            without, keep = "a folder without earlier results", " resume=true to keep them,"
            raise SettingError(
                "output",
                found=existing[0],
                expected=f"a readable {_SUMMARY} in the same folder" if resume else without,
                remedy=f"Give another folder,{'' if resume else keep} or overwrite=true.",
            )

    def earlier(
        self, settings: Mapping[str, Any], summary: Path | None = None
    ) -> dict[str, Entry] | None:
        """Return the entries, by name, of images whose files exist.

        Args:
            settings: Settings that earlier predictions must share.
            summary: File with the entries; ``summary.json`` by default.

        Returns:
            Entries by name; None without a summary.

        Raises:
            SettingError: Earlier predictions have other settings.
        """
        try:
            content = json.loads((summary or self.path / _SUMMARY).read_bytes())
            entries = {entry["name"]: entry for entry in self.predicted(content["images"])}
            changed = [f"{n}={v}" for n, v in settings.items() if v != content[n]]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if changed:
            raise SettingError(
                "resume",
                found=f"{changed[0]}, which differs from that of the results in {self.path}",
                expected="the same settings",
                remedy="Give another folder, or overwrite=true.",
            )
        return {name: entry for name, entry in entries.items() if self._is_complete(name, entry)}

    def predicted(self, entries: Sequence[Entry]) -> list[Entry]:
        """Return the entries of predicted images, without those of errors."""
        return [entry for entry in entries if self.head.summary in entry]

    def _is_complete(self, name: str, entry: Entry) -> bool:
        folder = self.of_frames if "frame" in entry else self
        return all(file.is_file() for file in folder.files(name).values())

    @property
    def of_frames(self) -> PredictionFolder:
        """The same folder for frames of a video, without pictures, which become videos."""
        return replace(self, kinds=[kind for kind in self.kinds if kind not in _PICTURES])

    def write_videos(
        self,
        name: str,
        path: Path,
        size: tuple[int, int, int],
        every: int,
        entries: Sequence[Entry],
        *,
        again: bool,
    ) -> None:
        """Write videos of pictures, as far as `kinds` contains them, from the frames' pixels.

        Args:
            name: Name of the video.
            path: File of the video.
            size: Number of frames, rows and columns.
            every: The first and then every n-th frame have predictions.
            entries: Entries of these frames.
            again: True to replace existing videos.

        Raises:
            DataError: The video, or the prediction of a frame, cannot be read.
        """

        def painted(paint: Painter, number: int, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
            file = self.of_frames.files(frame_name(name, number))[self.head.source]
            return paint(rgb, self.head.read(file))

        for kind in _PICTURES:
            file = self.path / kind / f"{name}.mp4"
            if kind in self.kinds and (again or not file.exists()):
                summaries = [e[self.head.summary] for e in entries]
                paint = self.head.painter(kind, summaries)
                write_video(file, path, size, partial(painted, paint), every)

    def write_summary(self, settings: Mapping[str, Any], entries: Sequence[Entry]) -> None:
        """Write ``summary.json``, ``summary.csv`` and, for labels, ``classes.json``.

        ``summary.json`` is the first file in a folder, so that a killed prediction can be
        continued.

        Args:
            settings: Settings of the prediction.
            entries: Entries of the images done so far.
        """
        content = {**settings, "images": entries}
        write_text(self.path / _SUMMARY, json.dumps(content, indent=1) + "\n")
        if self.head.class_names:
            write_text(self.path / "classes.json", _labels_by_name(self.head.class_names))
        columns, names = ("file", "rows", "columns"), dict.fromkeys(self.head.summary_columns)
        summaries = (entry.get(self.head.summary, {}) for entry in entries)
        rows = [
            [*map(entry.get, columns), *map(summary.get, names), entry.get("error")]
            for entry, summary in zip(entries, summaries, strict=True)
        ]
        write_text(self.path / "summary.csv", csv_text([*columns, *names, "error"], rows))

    def remove_summary(self) -> None:
        """Remove the files of `write_summary`, so that the command can be repeated."""
        for name in ("summary.csv", "classes.json", _SUMMARY):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # the folder has other files
            self.path.rmdir()

    def table(self, entries: Sequence[Entry]) -> Table:
        """Return a table of the predicted images."""
        summaries = [entry[self.head.summary] for entry in self.predicted(entries)]
        return Table(*self.head.table(summaries))

    def write_page(self, entries: Sequence[Entry], shown: Sequence[EncodedImage]) -> None:
        """Write ``report.html``.

        Args:
            entries: Entries of all images.
            shown: Compressed images for the viewer.
        """
        tables = [self.table(entries)]
        failed = [[entry["name"], entry["error"]] for entry in entries if "error" in entry]
        if failed:
            title, columns = "Images that could not be used", ("image", "error")
            tables.append(Table(title, columns, failed, "", (0, 1)))
        write_report(
            self.path / "report.html",
            "Predictions",
            tables=tables,
            images=shown,
            class_names=self.head.class_names,
            notes=[f"Shown: {len(shown)} of {counted(len(entries) - len(failed), 'images')}."],
        )


def _labels_by_name(class_names: Sequence[str]) -> str:
    """Return JSON of the labels by name, without classes that are called unknown."""
    labels: dict[str, list[int]] = {}
    for label, name in enumerate(map(composed, class_names)):
        if name != UNKNOWN_NAME:
            labels.setdefault(name, []).append(label)
    lines = (f" {json.dumps(name)}: {values}" for name, values in labels.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"
