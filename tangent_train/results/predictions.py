"""Write the files of predictions: pixels, pictures, a summary and a report page."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.core.label_map import UNKNOWN_NAME
from tangent_train.errors import counted
from tangent_train.files import csv_text, write_text
from tangent_train.heads.base import PICTURES
from tangent_train.io.image_files import composed
from tangent_train.io.videos import write_video
from tangent_train.results.page import EncodedImage, encode_image, write_report
from tangent_train.results.tables import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from tangent_train.heads.base import Head, PredictedImage
    from tangent_train.io.jobs import Job, Video

Entry = dict[str, Any]
"""Entry of an image: name, file, rows, columns and its summary, or name and error."""


def encode_prediction(
    head: Head, name: str, predicted: PredictedImage, confidence: NDArray[Any] | None = None
) -> EncodedImage:
    """Compress an image for the report, to 0.1 to a few megabytes.

    Args:
        head: Meaning of the pixels.
        name: Name of the image.
        predicted: Image with its prediction.
        confidence: Confidence of the labels in the whole image.
    """
    image, maps = predicted.image, head.report_maps(predicted)
    if image.area is not None:
        arrays = {k: image.area.place(m) for k, m in maps.items() if isinstance(m, np.ndarray)}
        maps |= arrays
    note = "" if confidence is None else f"mean confidence {100 * confidence.mean():.0f}\u00a0%"
    return encode_image(
        name,
        image.rgb,
        len(head.class_names),
        **maps,
        confidence=confidence,
        note=note,
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
        title: Title of the report.
    """

    path: Path
    head: Head
    kinds: Sequence[str]
    title: str = "Predictions"

    def files(self, job: Job) -> dict[str, Path]:
        """Return the files of an image by kind; the pixels of frames become videos of pictures."""
        kinds = set(self.kinds)
        if job.is_frame and kinds.intersection(PICTURES):
            kinds = kinds.difference(PICTURES) | {self.head.source}
        return {kind: self._file(kind, job.name) for kind in kinds}

    def _file(self, kind: str, name: str) -> Path:
        return self.path / kind / f"{name}{self.head.suffixes[kind]}"

    def write_videos(self, name: str, video: Video, every: int, entries: Sequence[Entry]) -> None:
        """Write the missing videos of pictures, from the predicted pixels of the frames.

        Args:
            name: Name of the video.
            video: Video.
            every: The first and then every n-th frame have predictions.
            entries: Entries of these frames.

        Raises:
            DataError: The video, or the prediction of a frame, cannot be read.
        """
        frames = {number: frame for frame, number in video.frames.items()}

        limits = self.head.limits([entry[self.head.summary] for entry in entries])

        def painted(kind: str, number: int, rgb: NDArray[Any]) -> Any:
            pixels = self.head.read(self._file(self.head.source, frames[number]))
            return self.head.paint(kind, rgb, pixels, limits)

        for kind in PICTURES:
            file = self.path / kind / f"{name}.mp4"
            if kind in self.kinds and not file.exists():
                write_video(file, video.path, video.size, partial(painted, kind), every, video.part)

    def write_summary(self, settings: Mapping[str, Any], entries: Sequence[Entry]) -> None:
        """Write ``summary.json``, ``summary.csv``, for labels ``classes.json``, and other tables.

        Args:
            settings: Settings of the prediction.
            entries: Entries of all images.
        """
        content = {**settings, "images": entries}
        write_text(self.path / "summary.json", json.dumps(content, indent=1) + "\n")
        self.head.write_tables(self.path, entries)
        labels: dict[str, list[int]] = {}
        for label, name in enumerate(map(composed, self.head.class_names)):
            if name != UNKNOWN_NAME:
                labels.setdefault(name, []).append(label)
        if labels:
            lines = (f" {json.dumps(name)}: {values}" for name, values in labels.items())
            write_text(self.path / "classes.json", "{\n" + ",\n".join(lines) + "\n}\n")
        place = ["frame", "time_s"] if any("frame" in entry for entry in entries) else []
        columns = ["name", "file", *place, "rows", "columns"]
        names = dict.fromkeys(self.head.summary_columns)
        rows = []
        for entry in entries:
            summary = entry.get(self.head.summary, {})
            rows.append([*map(entry.get, columns), *map(summary.get, names), entry.get("error")])
        write_text(self.path / "summary.csv", csv_text([*columns, *names, "error"], rows))

    def table(self, entries: Sequence[Entry]) -> Table:
        """Return a table of the predicted images."""
        summaries = [entry[self.head.summary] for entry in entries if "error" not in entry]
        title, header, rows = self.head.table(summaries)
        ranks = range(len(rows), 0, -1)  # sorted by share
        return Table(title, header, rows, shares=ranks, file="summary.json")

    def write_page(self, entries: Sequence[Entry], shown: Sequence[EncodedImage]) -> None:
        """Write ``report.html``.

        Args:
            entries: Entries of all images.
            shown: Compressed images for the viewer.
        """
        failed = [[entry["name"], entry["error"]] for entry in entries if "error" in entry]
        order = ", the least confident first" * any(image.confidence for image in shown)
        title = "Images that could not be used"
        errors = [Table(title, ("image", "error"), failed, text_columns=(0, 1))] if failed else []
        write_report(
            self.path / "report.html",
            self.title,
            tables=[self.table(entries), *errors],
            images=shown,
            class_names=self.head.class_names,
            notes=[
                f"Shown: {len(shown)} of {counted(len(entries) - len(failed), 'images')}{order}."
            ],
        )
