"""Base class of heads: the meaning of a network's output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from tangent_train.errors import SettingError
from tangent_train.geometry import pixel_solid_angles
from tangent_train.io.pixel_files import write_pixels
from tangent_train.metrics.image_sums import Sums
from tangent_train.metrics.scores import ScoreColumn
from tangent_train.rendering import Blend

if TYPE_CHECKING:
    from torchmetrics import Metric

RGB = NDArray[np.uint8]
"""A picture ``(H, W, 3)``."""

PICTURES = ("color", "overlay")
"""Kinds of output that are pictures; those of the frames of a video become videos."""

NOTHING: Mapping[str, Any] = MappingProxyType({})


class Scores(NamedTuple):
    """Scores of a split, shares of 1 or in a unit; NaN if undefined.

    Attributes:
        means: Scores over all images by name, the main score first.
        of_classes: Scores ``(K,)`` of the classes by name; empty without classes.
        bands: Scores of the latitude bands from north to south; empty for photos.
        confusion: Counts; rows are true, columns predicted classes. None without classes.
    """

    means: Mapping[str, float]
    of_classes: Mapping[str, NDArray[Any]] = NOTHING
    bands: Sequence[Mapping[str, float]] = ()
    confusion: NDArray[np.int64] | None = None


class PredictedImage(NamedTuple):
    """An image with its predicted pixels.

    Attributes:
        image: Photo, or image of the whole sphere.
        pixels: Prediction ``(h, w)`` for the area of the image, see `Head`.
        facts: Further facts about the prediction, for its summary.
    """

    image: Any
    pixels: NDArray[Any]
    facts: Mapping[str, Any] = NOTHING

    @classmethod
    def fetch(cls, image: Any, pixels: Tensor, facts: Mapping[str, Any]) -> Self:
        """Wait for the prediction of an image, and copy it from its device.

        Args:
            image: Photo, or image of the whole sphere.
            pixels: Prediction of all pixels of the image, see `Head.mosaic`.
            facts: Numbers may be tensors too.
        """
        array = image.cut(pixels.cpu().numpy())
        return cls(
            image, array, {n: float(f) if isinstance(f, Tensor) else f for n, f in facts.items()}
        )

    @property
    def solid_angles(self) -> NDArray[np.floating]:
        """Solid angles ``(h, w)`` of the pixels in steradians."""
        angles: NDArray[np.floating] = self.image.cut(
            pixel_solid_angles(self.image.shape, self.image.camera_matrix)
        )
        return angles


class Head(nn.Module, ABC):
    """The meaning of a network's output.

    A head trains a network (loss and norm), scores it, merges the outputs of views into a
    panorama, draws the result, and writes and reads its files. Tasks, the engine and the commands
    are the same for all heads. A head without files needs only the first two parts.

    Args:
        class_names: Names of the labels of the data; empty without classes.

    Attributes:
        kind: Kind of the predictions, by which files and commands select the head.
        labels: Kind of labels that a data set must have, see `datamodules.core.label_map`.
        columns: Names and units of the scores over a split, in the order of the tables.
        main_score: Score that selects the best epoch.
        num_outputs: Number of channels of the network's output.
        predict_settings: Settings of ``tangent-predict`` that are arguments of the head, each with
            the kind of output or the other setting that it needs; "" for none.
        consistency: Scores of `agreement` of each image ``(images,)``, by name of the column, if
            they are measured.
        suffixes: Suffixes of the files of an image, by kind of output. The first kind (`source`)
            holds the predicted pixels, from which pictures are drawn.
        usual_kinds: Kinds that are written by default, besides the first.
        summary: Name of the summary of an image in the summary file.
        summary_columns: Names in the summary of an image that ``summary.csv`` lists.
        unknown: Value of unknown pixels.
        waits: True if mosaics wait for their device before they return pixels; the next image is
            then predicted meanwhile.
    """

    kind: ClassVar[str]
    labels: ClassVar[str]
    columns: ClassVar[Mapping[str, ScoreColumn]]
    main_score: ClassVar[str]
    predict_settings: ClassVar[Mapping[str, str]] = NOTHING
    summary: ClassVar[str] = ""
    unknown: ClassVar[float] = 0
    usual_kinds: ClassVar[Sequence[str]] = PICTURES
    waits: ClassVar[bool] = False
    num_outputs: int
    consistency: Mapping[str, NDArray[np.float64]] = NOTHING
    suffixes: Mapping[str, str] = NOTHING
    summary_columns: Sequence[str] = ()

    def __init__(self, class_names: Sequence[str] = ()) -> None:
        super().__init__()
        self.class_names = tuple(class_names)

    # Training

    def read_data(self, data: Any) -> None:
        """Read values that the loss needs from the data module, such as class weights."""

    def truth(self, labels: Tensor) -> Tensor:
        """Return labels of the data in the form of predictions, e.g. meters instead of steps."""
        return labels

    def targets(self, truth: Tensor, ray_lengths: Tensor) -> Tensor:
        """Return the correct output of the network, for `loss_sum`.

        Args:
            truth: Result of `truth` for views ``(n, h, w)``.
            ray_lengths: ``(1 or n, h, w)``, see `Views.ray_lengths`.
        """
        return truth

    @abstractmethod
    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the sum of the losses of outputs ``(n, C, h, w)``."""

    @abstractmethod
    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the divisor of the summed losses of a step."""

    def auxiliary_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the sum of the losses of an auxiliary output, which may be coarser."""
        resized = nn.functional.interpolate(outputs, targets.shape[-2:], mode="bilinear")
        return self.loss_sum(resized, targets)

    # Scores

    @abstractmethod
    def build_metric(self) -> Metric:
        """Build the metric of a split: ``update(prediction, truth)`` adds an image."""

    @abstractmethod
    def scores(self, result: Any) -> Scores:
        """Return the scores of a split.

        Args:
            result: Value of the metric.
        """

    def image_sums(self, result: Any) -> Sums:
        """Return numbers of each image whose sums give the means; by default, none.

        Intervals, scores of groups and differences between evaluations follow from them.

        Args:
            result: Value of the metric.
        """
        return {}

    def agreement(self, first: PredictedImage, other: PredictedImage) -> dict[str, float]:
        """Compare the prediction for a rotated panorama, brought back, with the first one.

        Returns:
            Scores by the names in `sphere_columns`, by solid angle; NaN if undefined.
        """
        return {}

    @property
    def facts(self) -> dict[str, str]:
        """Facts that the scores depend on besides those of the data, see `DataModule.facts`."""
        return {}

    def mode_of(self, monitor: str) -> str:
        """Return ``min`` for a loss and for errors, see `ScoreColumn.better`; else ``max``.

        Args:
            monitor: Name of a logged value, e.g. ``val/miou``.
        """
        column = self.columns.get(monitor.partition("/")[2])
        is_error = column is not None and column.better == "lower"
        return "min" if is_error or monitor.endswith("loss") else "max"

    # From views to a panorama

    def mosaic(self, shape: tuple[int, int], blend: Blend, **settings: Any) -> Any:
        """Return an empty panorama or photo.

        Args:
            shape: ``(H, W)`` of the panorama or photo.
            blend: Blend of the views.
            **settings: ``averaged`` is True if several sets of views are averaged, or if more than
                the pixels is needed; ``device`` is the device of the outputs; ``valid`` is a mask
                ``(H, W)`` of a partial panorama, else None; ``camera_matrix`` is K of a photo, else
                None.

        Returns:
            An object with ``add(outputs, views)``, which adds the outputs ``(n, C, h, w)`` of some
            views, ``pixels()``, which returns the prediction ``(H, W)``, and ``facts`` about it.
            ``not_finite`` is the share of the pixels whose outputs are NaN or infinite. If it has
            ``add_segments(segments, views)``, that adds the objects of some views, see `Segments`.
        """

    def crop_pixels(self, outputs: Tensor, ray_lengths: Tensor) -> Any:
        """Return the prediction ``(n, h, w)`` of single crops of a photo.

        Args:
            outputs: Outputs of the network ``(n, C, h, w)``.
            ray_lengths: See `targets`.
        """

    def comparable(
        self, prediction: Tensor, truth: Tensor, ray_lengths: Tensor | None = None
    ) -> Tensor:
        """Return a prediction as the metric compares it with the truth, e.g. aligned in scale.

        Args:
            prediction: Prediction of a panorama ``(H, W)`` or of crops ``(n, h, w)``.
            truth: Truth of the same shape.
            ray_lengths: ``(n, h, w)`` of crops; None for a panorama.
        """
        return prediction

    # Pictures and files

    def panel(self, rgb: RGB, truth: NDArray[Any], prediction: NDArray[Any]) -> RGB | None:
        """Draw one prediction beside the truth; None if the head draws no pictures."""
        return None

    def error(self, prediction: Tensor, truth: Tensor) -> tuple[float, str]:
        """Return an error of one image, to sort images, and its score as text for the report."""
        return 0.0, ""

    def file_kinds(self, write: Sequence[str] | None) -> Sequence[str]:
        """Return the kinds of output of the setting `write`.

        Raises:
            SettingError: A kind belongs to other networks.
        """
        if foreign := set(write or ()).difference(self.suffixes):
            expected = f"{', '.join(self.suffixes)} for a network that predicts {self.source}"
            raise SettingError("write", found=", ".join(sorted(foreign)), expected=expected)
        usual = [kind for kind in self.suffixes if kind in (self.source, *self.usual_kinds)]
        return usual if write is None else write

    @property
    def source(self) -> str:
        """Kind of output that holds the predicted pixels."""
        return next(iter(self.suffixes))

    def write_mosaic(self, mosaic: Any, image: Any, files: Mapping[str, Path]) -> None:
        """Write files, by kind, that need more than the predicted pixels of an image."""

    def write(self, files: Mapping[str, Path], predicted: PredictedImage) -> None:
        """Write the predicted pixels and the pictures of one image, by kind."""
        for kind, file in files.items():
            if kind == self.source:
                self.write_source(file, predicted.pixels)
            elif kind in PICTURES:
                write_pixels(file, self.picture(kind, predicted))

    def write_source(self, file: Path, pixels: NDArray[Any]) -> None:
        """Write predicted pixels."""
        write_pixels(file, pixels)

    def read(self, file: Path) -> Any:
        """Read predicted pixels ``(h, w)`` from a file of `write_source`."""

    def paint(self, kind: str, rgb: RGB, pixels: NDArray[Any], limits: Any = None) -> Any:
        """Return the picture ``(h, w, 3)`` of an RGB image and its predicted pixels.

        Args:
            kind: Kind of output, e.g. ``color``.
            rgb: RGB image ``(h, w, 3)``.
            pixels: Predicted pixels ``(h, w)``.
            limits: Result of `limits` for frames of a video; None for a single image.
        """

    def limits(self, summaries: Sequence[Any]) -> Any:
        """Return the ends of the color scale of a video, given the summaries of its frames."""

    def picture(self, kind: str, predicted: PredictedImage) -> Any:
        """Return the picture of a single image, to which heads add a legend, see `paint`."""
        image, pixels, _ = predicted
        return self.paint(kind, image.cut(image.rgb), pixels)

    def report_maps(self, predicted: PredictedImage) -> dict[str, Any]:
        """Return the maps of one image in the report, by argument of `encode_image`."""
        return {"prediction": predicted.pixels}

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return the summary of one image.

        Args:
            predicted: Image with its prediction.
            is_counted: Mask ``(h, w)``, or of any shape that fits, that is True for counted pixels.
        """
        return {}

    def entry(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the part of the entry of one image in the summary file, see `summarize`."""
        return {self.summary: self.summarize(predicted, is_counted)}

    def write_tables(self, folder: Path, entries: Sequence[Mapping[str, Any]]) -> None:
        """Write further tables of all images to the output folder.

        Args:
            folder: Output folder.
            entries: Entries of all images in the summary file.
        """

    def table(self, summaries: Sequence[Any]) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        """Return title, header and rows of a table of the summaries of all images."""
        return "", (), ()
