"""Write predicted labels: label maps, probabilities, pictures and shares of the classes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.io.pixel_files import array_file, read_pixels, write_pixels
from tangent_train.results.pictures import colorize, mixed_picture, overlay_picture
from tangent_train.results.predictions import Entry, ImageResults, PredictedImage, solid_angles
from tangent_train.results.tables import Table, percent

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.io.gpano import PanoramaArea
    from tangent_train.rendering.mosaic import ScoreMosaic
    from tangent_train.results.predictions import Painter

_ROWS_AT_ONCE = 64


def class_shares(
    labeled: PredictedImage, class_names: Sequence[str], counted: NDArray[np.bool_] | bool = True
) -> dict[str, float]:
    """Return the share of the solid angle of each class, including the unknown class.

    Args:
        labeled: Panorama or photo with its labels.
        class_names: Names of the K + 1 labels, the unknown class first.
        counted: Mask ``(H, W)`` that is True for counted pixels; all by default.

    Returns:
        Shares by name; they add up to 1, or are all 0 if everything is masked.
    """
    labels, count = labeled.pixels, len(class_names)
    total, is_counted = np.zeros(count), np.broadcast_to(counted, labels.shape)
    for line, weights, mask in zip(labels, solid_angles(labeled), is_counted, strict=True):
        total += np.bincount(line, weights * mask, minlength=count)
    shares = dict.fromkeys(class_names, 0.0)  # another class may be called unknown too
    for name, share in zip(class_names, total / (total.sum() or 1), strict=True):
        shares[name] += float(share)
    return shares


class LabelResults(ImageResults):
    """Results of a network that predicts labels; see `ImageResults`.

    Args:
        class_names: Names of the K + 1 labels, the unknown class first.
    """

    summary = "classes"
    suffixes = dict.fromkeys(("labels", "color", "overlay"), ".png") | {"probabilities": ".npy"}
    unknown = 0

    def __init__(self, class_names: Sequence[str]) -> None:
        self.class_names = self.columns = class_names

    def write(self, files: Mapping[str, Path], predicted: PredictedImage) -> None:
        """Write labels and pictures."""
        image, labels, _ = predicted
        if "labels" in files:
            write_pixels(files["labels"], labels)
        if "color" in files:
            write_pixels(files["color"], colorize(labels, len(self.class_names)))
        if "overlay" in files:
            picture = overlay_picture(image.cut(image.rgb), labels, self.class_names)
            write_pixels(files["overlay"], picture)

    def write_probabilities(
        self, file: Path, scores: ScoreMosaic, area: PanoramaArea | None = None
    ) -> None:
        """Write the probabilities of one image.

        Args:
            file: Array of float16 ``(rows, columns, K)``.
            scores: Scores of the photo, or of the whole sphere.
            area: Part of the sphere to write; None for all.
        """
        everywhere = np.arange(scores.shape[0]), np.arange(scores.shape[1])
        rows, columns = everywhere if area is None else area.places()
        shape = (len(rows), len(columns), len(self.class_names) - 1)
        with array_file(file, shape, np.float16) as array:
            for start in range(0, len(rows), _ROWS_AT_ONCE):
                part = slice(start, start + _ROWS_AT_ONCE)
                probabilities = scores.probabilities(rows[part]).cpu().numpy()
                array[part] = probabilities[:, columns, : shape[-1]]

    def read(self, file: Path) -> NDArray[Any]:
        """Read labels."""
        return read_pixels(file, indices=True)

    def painter(self, kind: str, entries: Sequence[Entry]) -> Painter:
        """Color the labels, or overlay the frame with them."""
        count = len(self.class_names)
        if kind == "color":
            return lambda rgb, labels: colorize(labels, count)
        return lambda rgb, labels: mixed_picture(rgb, labels, count)

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return the shares of the classes."""
        return class_shares(predicted, self.class_names, is_counted)

    def table(self, entries: Sequence[Entry]) -> Table:
        """Return the mean of `class_shares` over the images for classes that occur, sorted."""
        shares, count = [entry["classes"] for entry in entries], max(1, len(entries))
        mean = {name: sum(of[name] for of in shares) / count for name in self.class_names}
        seen = sorted(filter(mean.get, mean), key=mean.__getitem__, reverse=True)
        rows = [[name, percent(mean[name])] for name in seen]
        return Table("Mean over the images", ["class", "solid angle, %"], rows)
