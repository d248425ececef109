"""Predict images with the head of a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from datamodules.core.labels import PIXEL_CLASSES
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.cli.settings import check_unread
from tangent_train.config.settings import PredictSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.heads import HEADS, PredictedImage, head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage, with_up
from tangent_train.inference.label_maps import load_label_map, map_classes
from tangent_train.inference.up_likelihood import UpLikelihood
from tangent_train.inference.views import PanoramaViews, PhotoViews

_OF_HEADS = {"min_confidence": 0, "min_share": 0, "align": None, "depth_format": None, "points": None}
"""Settings of single heads, with the value that is not read."""


class Prediction:
    """Predicts images.

    Args:
        settings: Settings of the command.
        original: Network with its original classes, which estimates the up direction. The network
            of `label_map` predicts the labels.
        views: Views of an image.

    Attributes:
        head: Files, pictures and summary of the predictions.

    Raises:
        SettingError: A setting does not suit the network.
    """

    def __init__(
        self, settings: PredictSettings, original: LoadedNetwork, views: PanoramaViews | PhotoViews
    ) -> None:
        self._settings, loaded = settings, original
        taken = HEADS[original.predicts].predict_settings
        unread = {name: value for name, value in _OF_HEADS.items() if name not in taken}
        check_unread(settings, f"for a network that predicts {original.predicts}", **unread)
        if settings.label_map is not None:
            label_map = load_label_map(settings.label_map)
            mapped = map_classes(original, label_map, settings.unmapped)
            print_text(f"Label map {settings.label_map}: {mapped}.")
            loaded = mapped.loaded
        has_confidences = loaded.predicts == PIXEL_CLASSES
        if settings.upright == "auto" and not has_confidences:
            expected = "pose or null: depth networks do not estimate the up direction"
            raise SettingError("upright", found="auto", expected=expected)
        self.head: Any = head_of(loaded, **{name: getattr(settings, name) for name in taken})
        self._predictor = Predictor(
            loaded, self.head, views, settings.device, settings.view_batch_size
        )
        self._up_likelihood = UpLikelihood(original, self._predictor.device)

    def prepare(self, examples: Iterable[Callable[[], InputImage]]) -> None:
        """Let the head count in some of the images, see `Head.count`.

        Args:
            examples: Functions that read some of the images.
        """
        if line := self.head.count(self._mosaics(examples)):
            print_text(line)

    def _mosaics(self, examples: Iterable[Callable[[], InputImage]]) -> Iterator[Any]:
        for read in examples:
            with suppress(DataError, SettingError):  # reported when the image is predicted
                yield self._predictor.predict(self._upright(read()), averaged=True)

    def __call__(
        self, image: InputImage, files: Mapping[str, Path], progress: Callable[[float], object]
    ) -> PredictedImage:
        """Predict one image; write the files that need more than the pixels.

        Args:
            image: Panorama or photo.
            files: Files of the image by kind of output.
            progress: See `Predictor.predict`.
        """
        image, averaged = self._upright(image), "probabilities" in files
        mosaic = self._predictor.predict(image, progress, averaged=averaged)
        # Not written in another thread: probabilities take much memory.
        return self.head.predicted(mosaic, image, files)  # type: ignore[no-any-return]

    def _upright(self, image: InputImage) -> InputImage:
        if self._settings.upright != "auto":
            return image
        return with_up(image, self._settings.max_tilt_deg, self._up_likelihood)
