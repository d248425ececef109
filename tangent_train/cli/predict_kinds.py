"""Predict labels or depth: the parts of ``tangent-predict`` that depend on the kind of network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.core.labels import DISTANCE, PIXEL_CLASSES
from tangent_train.checkpoints.distances import is_metric
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.cli.settings import check_unread
from tangent_train.config.settings import PredictSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.confidences import class_thresholds, count_confidences
from tangent_train.inference.depth import DepthPredictor
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage, with_up
from tangent_train.inference.judge import NetworkJudge
from tangent_train.inference.label_maps import load_label_map, map_classes
from tangent_train.inference.representations import PanoramaViews, PhotoViews
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.results.depth_results import DepthResults
from tangent_train.results.label_results import LabelResults
from tangent_train.results.predictions import PredictedImage

_OF_CLASSES = {"label_map": None, "unmapped": "unknown", "min_confidence": 0, "min_share": 0}
_OF_DEPTH = {"align": None, "depth_format": None, "points": None}


class LabelPrediction:
    """Predicts the labels of images.

    Args:
        settings: Settings of the command.
        original: Network with its original classes, which estimates the up direction. The network
            of `label_map` predicts the labels.
        views: Views of an image.

    Attributes:
        results: Files, pictures and summary of the predictions.

    Raises:
        SettingError: A setting does not suit the network.
    """

    announcement = "A panorama is labeled"

    def __init__(
        self, settings: PredictSettings, original: LoadedNetwork, views: PanoramaViews | PhotoViews
    ) -> None:
        check_unread(settings, "for networks of classes", **_OF_DEPTH)
        if settings.depth is None:
            check_unread(settings, "without depth files", depth_scale=1000)
        _check_confidence(settings)
        self._settings, self._trained = settings, original
        if settings.label_map is not None:
            label_map = load_label_map(settings.label_map)
            mapped = map_classes(original, label_map, settings.unmapped)
            print_text(f"Label map {label_map.name}: {mapped}.")
            self._trained = mapped.trained
        # With `min_share`, a threshold of each class replaces it.
        least = 0.0 if settings.min_share else settings.min_confidence
        how = settings.device, settings.view_batch_size, least
        self._predictor = Predictor(self._trained, views, *how)
        self._judge = NetworkJudge(original, self._predictor.device)
        self._thresholds: NDArray[np.float64] | None = None
        self.results = LabelResults(self._trained.class_names)

    def prepare(self, examples: Iterable[Callable[[], InputImage]]) -> None:
        """Find the confidence that each class needs, see `min_share`.

        Args:
            examples: Functions that read some of the images.
        """
        settings, names = self._settings, self._trained.class_names[1:]
        if not settings.min_share:
            return
        counts = np.zeros((len(names) + 1, 1), np.int64)
        for read in examples:
            with suppress(DataError, SettingError):  # reported when the image is labeled
                image, scores = self._scores(read())
                labels = self._trained.labels(scores.labels())
                maps = image.cut(labels), image.cut(scores.confidences())
                counts = counts + count_confidences(*maps, len(names))
        self._thresholds = class_thresholds(counts, settings.min_confidence, settings.min_share)
        least = zip(names, self._thresholds[1:], strict=True)
        listed = ", ".join(f"{name} {confidence:.2f}" for name, confidence in least)
        print_text(f"Smallest confidence of each class: {listed}.")

    def __call__(
        self, image: InputImage, files: Mapping[str, Path], progress: Callable[[float], object]
    ) -> PredictedImage:
        """Predict the labels of one image; write its probabilities if `files` contains them.

        Args:
            image: Panorama or photo.
            files: Files of the image by kind of output.
            progress: See `Predictor.predict`.
        """
        image, scores = self._scores(image, progress)
        if "probabilities" in files:
            # Not written in another thread: scores take much memory.
            self.results.write_probabilities(files["probabilities"], scores, image.area)
        labels = self._trained.labels(scores.labels())
        if self._thresholds is not None:
            is_sure = scores.confidences() >= self._thresholds[labels]
            labels = np.where(is_sure, labels, labels.dtype.type(0))
        return PredictedImage(image, image.cut(labels))

    def _scores(
        self, image: InputImage, progress: Callable[[float], object] = lambda share: None
    ) -> tuple[InputImage, ScoreMosaic]:
        """Predict the scores of one image; return it with its up direction."""
        settings = self._settings
        if settings.upright == "auto":
            image = with_up(image, settings.max_tilt_deg, self._judge)
        keeps_sums = settings.min_share > 0 or "probabilities" in (settings.write or ())
        return image, self._predictor.predict(image, progress, probabilities=keeps_sums)


class DepthPrediction:
    """Predicts the depth of images; see `LabelPrediction`."""

    announcement = "The depth of a panorama is predicted"

    def __init__(
        self, settings: PredictSettings, trained: LoadedNetwork, views: PanoramaViews | PhotoViews
    ) -> None:
        check_unread(settings, "for depth networks", **_OF_CLASSES)
        if settings.upright == "auto":
            expected = "pose or null: depth networks do not estimate the up direction"
            raise SettingError("upright", found="auto", expected=expected)
        kind: Any = trained.depth_kind
        self.results = DepthResults(
            is_metric=is_metric(kind),
            depth_format=settings.depth_format,
            depth_scale=settings.depth_scale,
            points=settings.points,
        )
        written = self.results.kinds(settings.write)
        if "depth" not in written:
            check_unread(settings, "without depth in write", depth_format=None)
        if "depth" not in written or settings.depth_format not in (None, "png"):
            check_unread(settings, "without depth files of integers", depth_scale=1000)
        if "points" not in written:
            check_unread(settings, "without points in write", points=None)
        how = settings.device, settings.view_batch_size, settings.align
        self._predictor = DepthPredictor(trained, views, *how)

    def prepare(self, examples: Iterable[Callable[[], InputImage]]) -> None:
        """Do nothing."""

    def __call__(
        self, image: InputImage, files: Mapping[str, Path], progress: Callable[[float], object]
    ) -> PredictedImage:
        """Predict the depth of one image, see `DepthResults`."""
        found = self._predictor.predict(image, progress)
        depth = found.depth(image.camera_matrix).cpu().numpy()
        report = asdict(found.report)
        facts = {name: len(v) if isinstance(v, tuple) else v for name, v in report.items()}
        return PredictedImage(image, image.cut(depth), facts)


Prediction = LabelPrediction | DepthPrediction

PREDICTIONS: dict[str, type[Prediction]] = {
    PIXEL_CLASSES: LabelPrediction,
    DISTANCE: DepthPrediction,
}
"""Classes by the kind of labels that a network predicts."""


def _check_confidence(settings: PredictSettings) -> None:
    if not 0 <= settings.min_share < 1:
        raise SettingError("min_share", found=settings.min_share, expected="0 to below 1")
    if settings.min_share and not 0 < settings.min_confidence <= 1:
        raise SettingError(
            "min_confidence",
            found=settings.min_confidence,
            expected="above 0 to 1 with min_share, which lowers it for single classes",
        )
