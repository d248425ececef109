"""Predict depth of images: the part of ``tangent-predict`` for depth networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from datamodules.images.gpano import PanoramaArea
from tangent_train.checkpoints.distances import is_metric
from tangent_train.checkpoints.trained import TrainedNetwork
from tangent_train.cli.command_settings import PredictSettings
from tangent_train.cli.settings import check_unread
from tangent_train.errors import SettingError
from tangent_train.inference.depth import DepthPredictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.representations import PanoramaViews, PhotoViews
from tangent_train.results.depth_results import DepthResults
from tangent_train.results.predictions import PredictedImage

_OF_CLASSES = {"class_map": None, "unmapped": "unknown", "min_confidence": 0, "min_share": 0}


class DepthPrediction:
    """Predicts the depth of images; see `LabelPrediction`."""

    announcement = "The depth of a panorama is predicted"

    def __init__(
        self, settings: PredictSettings, trained: TrainedNetwork, views: PanoramaViews | PhotoViews
    ) -> None:
        check_unread(settings, "for depth networks", **_OF_CLASSES)
        if settings.upright == "auto":
            expected = "pose or null: depth networks do not estimate the up direction"
            raise SettingError("upright", found="auto", expected=expected)
        how = settings.device, settings.images_per_forward, settings.align
        self._predictor = DepthPredictor(trained, views, *how)
        self.results = DepthResults(
            is_metric=is_metric(trained.depth_kind),
            depth_format=settings.depth_format,
            depth_scale=settings.depth_scale,
            points=settings.points,
        )

    def prepare(self, examples: Callable[[int], Any]) -> None:
        """Do nothing."""

    def __call__(
        self,
        image: InputImage,
        area: PanoramaArea | None,
        files: Mapping[str, Path],
        progress: Callable[[float], object],
    ) -> PredictedImage:
        """Predict the depth of one image, see `DepthResults`."""
        found = self._predictor.predict(image, progress)
        depth = found.depth(image.camera_matrix).cpu().numpy()
        report = found.report
        facts = {
            "align": report.mode,
            "views": report.views,
            "step_before": report.step_before,
            "step_after": report.step_after,
            "views_without_overlap": len(report.isolated),
        }
        return PredictedImage(image, depth if area is None else area.cut(depth), area, facts)
