"""Write the files of predictions: label maps, pictures, a summary and a report page."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from datamodules.folder.classes import UNKNOWN_NAME
from datamodules.images.image_files import composed
from datamodules.images.pixel_files import array_file, read_pixels, write_pixels
from datamodules.images.videos import write_video
from tangent_train.errors import SettingError, counted
from tangent_train.files import csv_text, parse_json, write_text
from tangent_train.geometry import equirect_solid_angles
from tangent_train.results.html import EncodedImage, encode_image, write_report
from tangent_train.results.pictures import colorize, mixed_picture, overlay_picture
from tangent_train.results.tables import Table, percent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from datamodules.images.gpano import PanoramaArea
    from tangent_train.inference.images import InputImage
    from tangent_train.rendering.mosaic import ScoreMosaic


_ROWS_AT_ONCE = 64
_SUMMARY = "summary.json"
_RESULTS = (
    "labels", "color", "overlay", "probabilities",
    "classes.json", _SUMMARY, "summary.csv", "report.html", "shards",
)  # fmt: skip

OutputKind = Literal["labels", "color", "overlay", "probabilities"]
"""Kinds of output of an image, each in a separate folder."""

_PICTURES: tuple[OutputKind, ...] = ("color", "overlay")

Entry = dict[str, Any]
"""Entry of an image: file, name, rows, columns and ``classes``, or file, name and error."""


def frame_name(video: str, number: int) -> str:
    """Return the name of a video's frame, e.g. ``walk/000012``; numbers start at 0."""
    return f"{video}/{number:06d}"


def is_result_in(output: Path) -> Callable[[Path], bool]:
    """Return a function that is True for files of predictions in an output folder."""
    results = [(output / name).resolve() for name in _RESULTS]
    return lambda path: any(path.resolve().is_relative_to(result) for result in results)


class LabeledImage(NamedTuple):
    """An image with its labels.

    Attributes:
        image: Photo, or image of the whole sphere.
        labels: Labels ``(h, w)`` of the image, or of its area; 0 is unknown.
        area: Part of the sphere that the labels cover; None for photos.
    """

    image: InputImage
    labels: NDArray[np.unsignedinteger]
    area: PanoramaArea | None = None


def class_shares(
    labeled: LabeledImage, class_names: Sequence[str], counted: NDArray[np.bool_] | bool = True
) -> dict[str, float]:
    """Return the share of the solid angle of each class, including the unknown class.

    Args:
        labeled: Panorama or photo.
        class_names: Names of the K + 1 labels, the unknown class first.
        counted: Mask ``(H, W)`` that is True for counted pixels; all by default.

    Returns:
        Shares by name; they add up to 1, or are all 0 if everything is masked.
    """
    labels, count = labeled.labels, len(class_names)
    total, is_counted = np.zeros(count), np.broadcast_to(counted, labels.shape)
    for line, weights, mask in zip(labels, _solid_angles(labeled), is_counted, strict=True):
        total += np.bincount(line, weights * mask, minlength=count)
    shares = dict.fromkeys(class_names, 0.0)  # another class may be called unknown too
    for name, share in zip(class_names, total / (total.sum() or 1), strict=True):
        shares[name] += float(share)
    return shares


def _solid_angles(labeled: LabeledImage) -> Iterator[NDArray[np.float64]]:
    """Yield the relative solid angles of the pixels row by row, which saves memory.

    A photo's pixel at (x, y) on the plane at distance 1 has the solid angle (1 + x² + y²)^(−3/2).
    """
    image, (height, width) = labeled.image, labeled.labels.shape
    if image.camera_matrix is None:
        rows = equirect_solid_angles((image.rgb.shape[0], image.rgb.shape[1])).ravel()
        for weight in rows if labeled.area is None else rows[labeled.area.places()[0]]:
            yield np.full(width, weight)
        return
    (fx, _, cx), (_, fy, cy), _ = image.camera_matrix
    x = (np.arange(width) - cx) / fx
    for row in range(height):
        yield (1 + x**2 + ((row - cy) / fy) ** 2) ** -1.5


@dataclass(frozen=True)
class PredictionFolder:
    """Output folder of predictions.

    Attributes:
        path: Folder.
        class_names: Names of the K + 1 labels, the unknown class first.
        kinds: Kinds of output to write.
    """

    path: Path
    class_names: Sequence[str]
    kinds: Sequence[OutputKind]

    def files(self, name: str) -> dict[str, Path]:
        """Return the files of one image by kind."""
        suffixes = {kind: ".npy" if kind == "probabilities" else ".png" for kind in self.kinds}
        return {kind: self.path / kind / f"{name}{suffix}" for kind, suffix in suffixes.items()}

    def check(self, *, resume: bool) -> None:
        """Refuse a folder with earlier results.

        Args:
            resume: True if earlier results were to be continued, but have no summary.

        Raises:
            SettingError: The folder has earlier results.
        """
        existing = [path for name in _RESULTS if (path := self.path / name).exists()]
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
            content = parse_json((summary or self.path / _SUMMARY).read_bytes())
            entries = {entry["name"]: entry for entry in content["images"] if "classes" in entry}
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

    def _is_complete(self, name: str, entry: Entry) -> bool:
        folder = self.of_frames if "frame" in entry else self
        return all(file.is_file() for file in folder.files(name).values())

    @property
    def of_frames(self) -> PredictionFolder:
        """The same folder for frames of a video, without pictures, which become videos."""
        return replace(self, kinds=[kind for kind in self.kinds if kind not in _PICTURES])

    def write(self, name: str, labeled: LabeledImage) -> None:
        """Write labels and pictures of one image, as far as `kinds` contains them.

        Args:
            name: Name of the image, see `short_names`.
            labeled: Image with its labels.
        """
        (image, labels, area), files = labeled, self.files(name)
        if "labels" in files:
            write_pixels(files["labels"], labels)
        if "color" in files:
            write_pixels(files["color"], colorize(labels, len(self.class_names)))
        if "overlay" in files:
            rgb = image.rgb if area is None else area.cut(image.rgb)
            write_pixels(files["overlay"], overlay_picture(rgb, labels, self.class_names))

    def write_videos(
        self, name: str, path: Path, size: tuple[int, int, int], every: int, *, again: bool
    ) -> None:
        """Write videos of pictures, as far as `kinds` contains them, from the frames' labels.

        Args:
            name: Name of the video.
            path: File of the video.
            size: Number of frames, rows and columns.
            every: The first and then every n-th frame have labels.
            again: True to replace existing videos.

        Raises:
            DataError: The video, or the labels of a frame, cannot be read.
        """
        for kind in _PICTURES:
            file = self.path / kind / f"{name}.mp4"
            if kind in self.kinds and (again or not file.exists()):
                write_video(file, path, size, partial(self._painted, name, kind), every)

    def _painted(
        self, name: str, kind: OutputKind, number: int, rgb: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        labels = read_pixels(self.of_frames.files(frame_name(name, number))["labels"], indices=True)
        count = len(self.class_names)
        return colorize(labels, count) if kind == "color" else mixed_picture(rgb, labels, count)

    def write_probabilities(
        self, name: str, scores: ScoreMosaic, area: PanoramaArea | None = None
    ) -> None:
        """Write the probabilities of one image if `kinds` contains them.

        Args:
            name: Name of the image, see `short_names`.
            scores: Scores of the photo, or of the whole sphere.
            area: Part of the sphere to write; None for all.
        """
        file = self.files(name).get("probabilities")
        if file is None:
            return
        everywhere = np.arange(scores.shape[0]), np.arange(scores.shape[1])
        rows, columns = everywhere if area is None else area.places()
        shape = (len(rows), len(columns), len(self.class_names) - 1)
        with array_file(file, shape, np.float16) as array:
            for start in range(0, len(rows), _ROWS_AT_ONCE):
                part = slice(start, start + _ROWS_AT_ONCE)
                probabilities = scores.probabilities(rows[part]).cpu().numpy()
                array[part] = probabilities[:, columns, : shape[-1]]

    def write_summary(self, settings: Mapping[str, Any], entries: Sequence[Entry]) -> None:
        """Write ``summary.json``, ``summary.csv`` and ``classes.json`` (labels by name).

        ``classes.json`` lacks classes that are called unknown. ``summary.json`` is the first file
        in a folder, so that a killed prediction can be continued.

        Args:
            settings: Settings of the prediction.
            entries: Entries of the images done so far.
        """
        content = {**settings, "images": entries}
        write_text(self.path / _SUMMARY, json.dumps(content, indent=1) + "\n")
        names = dict.fromkeys(self.class_names)
        labels: dict[str, list[int]] = {}
        for label, name in enumerate(map(composed, self.class_names)):
            if name != UNKNOWN_NAME:
                labels.setdefault(name, []).append(label)
        lines = (f" {json.dumps(name)}: {values}" for name, values in labels.items())
        write_text(self.path / "classes.json", "{\n" + ",\n".join(lines) + "\n}\n")
        columns = ("file", "rows", "columns")
        rows = [
            [*map(e.get, columns), *(e.get("classes", {}).get(n) for n in names), e.get("error")]
            for e in entries
        ]
        write_text(self.path / "summary.csv", csv_text([*columns, *names, "error"], rows))

    def remove_summary(self) -> None:
        """Remove the files of `write_summary`, so that the command can be repeated."""
        for name in ("summary.csv", "classes.json", _SUMMARY):
            (self.path / name).unlink(missing_ok=True)
        with suppress(OSError):  # the folder has other files
            self.path.rmdir()

    def mean_shares(self, entries: Sequence[Entry]) -> Table:
        """Return the mean of `class_shares` over the images for classes that occur, sorted."""
        shares = [entry["classes"] for entry in entries if "classes" in entry]
        count = max(1, len(shares))
        mean = {name: sum(of[name] for of in shares) / count for name in self.class_names}
        seen = sorted(filter(mean.get, mean), key=mean.__getitem__, reverse=True)
        rows = [[name, percent(mean[name])] for name in seen]
        return Table("Mean over the images", ["class", "solid angle, %"], rows)

    def viewer_image(self, name: str, labeled: LabeledImage) -> EncodedImage:
        """Compress an image for `write_page`, to 0.1 to a few megabytes."""
        (image, labels, area), count = labeled, len(self.class_names)
        placed = labels if area is None else area.place(labels)
        return encode_image(name, image.rgb, count, prediction=placed, sphere=area is not None)

    def write_page(self, entries: Sequence[Entry], shown: Sequence[EncodedImage]) -> None:
        """Write ``report.html``.

        Args:
            entries: Entries of all images.
            shown: Compressed images for the viewer.
        """
        tables = [self.mean_shares(entries)]
        failed = [[entry["name"], entry["error"]] for entry in entries if "error" in entry]
        if failed:
            tables.append(
                Table("Images that could not be used", ["image", "error"], failed, "", (0, 1))
            )
        write_report(
            self.path / "report.html",
            "Predictions",
            tables=tables,
            images=shown,
            class_names=self.class_names,
            notes=[f"Shown: {len(shown)} of {counted(len(entries) - len(failed), 'images')}."],
        )
