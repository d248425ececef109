"""Head for classes: a class for every pixel."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.label_map import PIXEL_CLASSES, ClassWeights
from tangent_train.errors import SettingError
from tangent_train.heads.base import (
    RGB,
    Head,
    Painter,
    PredictedImage,
    Scores,
    SummaryTable,
    solid_angles,
)
from tangent_train.heads.losses import auxiliary_sum, cross_entropy_norm, cross_entropy_sum
from tangent_train.heads.pictures import (
    colorize,
    mixed_picture,
    overlay_picture,
    prediction_panel,
)
from tangent_train.io.pixel_files import array_file, read_pixels, write_pixels
from tangent_train.metrics.scores import (
    Interval,
    ScoreColumn,
    bootstrap,
    by_solid_angle,
    with_solid_angle,
)
from tangent_train.metrics.segmentation import (
    AbsentClass,
    SegmentationCounts,
    SegmentationMetric,
    count_image,
    mean_scores,
    segmentation_scores,
)
from tangent_train.rendering import Blend
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.mosaic import ScoreMosaic

_ROWS_AT_ONCE = 64
_BINS = 256


class ClassesHead(Head):
    """One of K classes for every pixel; output k of the network is the logit of label k + 1.

    The loss is the cross-entropy, weighted by class. Views are put together by their
    probabilities. All images are scored in one confusion matrix.

    Args:
        class_names: Names of the K + 1 labels, the unknown class first.
        class_weights: Weights of the loss: a name (``none``, ``log``, ``sqrt``), for weights that
            the data module computes, or K numbers.
        label_smoothing: Fraction of the target that is spread over all classes.
        absent_class: Treatment of classes absent from the ground truth in the means.
        min_confidence: Predicted pixels with a lower confidence, from 0 to 1, are unknown.
        min_share: Share of the pixels of each class that is kept at least: lowers
            `min_confidence` for single classes, see `count`. 0 for the same confidence for all.

    Raises:
        SettingError: A setting is invalid.
    """

    kind: ClassVar[str] = PIXEL_CLASSES
    labels: ClassVar[str] = PIXEL_CLASSES
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "macc": ScoreColumn("mAcc", "%", "accuracy", "accuracy"),
            "miou": ScoreColumn("mIoU", "%", "iou", "IoU"),
        }
    )
    main_score: ClassVar[str] = "miou"
    takes: ClassVar[str] = "images (n, C, h, w) to logits of every pixel (n, K, h, w)"
    predict_settings: ClassVar[Mapping[str, str]] = {"min_confidence": "", "min_share": ""}
    summary: ClassVar[str] = "classes"
    suffixes = MappingProxyType(
        dict.fromkeys(("labels", "color", "overlay"), ".png") | {"probabilities": ".npy"}
    )
    class_weights: Tensor

    def __init__(
        self,
        class_names: Sequence[str],
        class_weights: ClassWeights | Sequence[float] = "none",
        label_smoothing: float = 0.0,
        absent_class: AbsentClass = "skip",
        min_confidence: float = 0.0,
        min_share: float = 0.0,
    ) -> None:
        super().__init__(class_names)
        check_choice("task.head.absent_class", absent_class, get_args(AbsentClass))
        names, classes = get_args(ClassWeights), self.class_names[1:]
        is_name = isinstance(class_weights, str)
        if not (class_weights in names if is_name else len(class_weights) == len(classes)):
            expected = f"{', '.join(names)}; or {len(classes)} numbers, for {', '.join(classes)}"
            raise SettingError("task.head.class_weights", found=class_weights, expected=expected)
        if not 0 <= min_confidence <= 1:
            raise SettingError("min_confidence", found=min_confidence, expected="0 to 1")
        if not 0 <= min_share < 1 or (min_share and not min_confidence):
            expected = "0 to below 1, with min_confidence, which it lowers for single classes"
            raise SettingError("min_share", found=min_share, expected=expected)
        self.summary_columns = self.class_names
        self.num_outputs = len(classes)
        self.weighting = class_weights
        self.label_smoothing = label_smoothing
        self.absent_class: AbsentClass = absent_class
        self.min_confidence, self.min_share = min_confidence, min_share
        self.thresholds: NDArray[np.float64] | None = None
        self._spare: deque[NDArray[np.float32]] = deque(maxlen=1)
        self.register_buffer("class_weights", torch.ones(len(classes)))

    # Training

    def read_data(self, data: Any) -> None:
        """Set the class weights."""
        named = isinstance(self.weighting, str)
        weights: Any = data.class_weights(self.weighting) if named else self.weighting
        self.class_weights.copy_(torch.as_tensor(weights, dtype=torch.float32))

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the weighted cross-entropy, summed over pixels."""
        return cross_entropy_sum(outputs, targets, self.class_weights, self.label_smoothing)

    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the sum of the class weights of the labeled pixels."""
        return cross_entropy_norm(targets, self.class_weights)

    def auxiliary_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the cross-entropy of coarser logits, see `losses.auxiliary_sum`."""
        return auxiliary_sum(outputs, targets, self.class_weights)

    # Scores

    def build_metric(self) -> SegmentationMetric:
        """Build the confusion matrices of pixels, latitude bands and solid angles."""
        return SegmentationMetric(len(self.class_names))

    def scores(self, result: SegmentationCounts) -> Scores:
        """Return scores by pixels; for panoramas, also by solid angle and latitude."""
        is_panorama, for_angles = self._absent_by_angle(result)
        pixels = segmentation_scores(result.pixels, self.absent_class)
        angles = segmentation_scores(result.solid_angle, for_angles)
        bands = [
            segmentation_scores(band, self.absent_class if band.any() else "skip").means
            for band in result.bands
        ]
        return Scores(
            pixels.means | (by_solid_angle(angles.means) if is_panorama else {}),
            pixels.of_classes | by_solid_angle(angles.of_classes) | {"share": pixels.share},
            bands if is_panorama else (),
            result.pixels,
        )

    def intervals(self, result: SegmentationCounts) -> dict[str, Interval]:
        """Return intervals of the means."""
        pixels, angles = result.of_images.swapaxes(0, 1)
        score_angles = partial(mean_scores, absent_class=self._absent_by_angle(result)[1])
        of_angles = bootstrap(angles, score_angles)
        of_pixels = bootstrap(pixels, partial(mean_scores, absent_class=self.absent_class))
        return of_pixels | by_solid_angle(of_angles)

    def scores_of(self, result: SegmentationCounts, places: Sequence[int]) -> dict[str, float]:
        """Return mIoU and mAcc, of panoramas also by solid angle."""
        is_panorama, for_angles = self._absent_by_angle(result)
        pixels, angles = result.of_images[list(places)].sum(axis=0)
        scores = mean_scores(pixels, self.absent_class)
        scores |= by_solid_angle(mean_scores(angles, for_angles)) if is_panorama else {}
        return {name: float(score) for name, score in scores.items()}

    def _absent_by_angle(self, result: SegmentationCounts) -> tuple[bool, AbsentClass]:
        """Return True for panoramas, and the treatment of absent classes by solid angle."""
        is_panorama = bool(result.solid_angle.any())
        return is_panorama, self.absent_class if is_panorama else "skip"

    @property
    def facts(self) -> dict[str, str]:
        """The scores count pixels of all images together, then average classes."""
        return {"absent_class": self.absent_class, "weighting": "pixels"}

    # From views to a panorama

    def mosaic(
        self,
        shape: tuple[int, int],
        blend: Blend,
        *,
        averaged: bool = False,
        device: Any = "cpu",
        valid: NDArray[np.bool_] | None = None,
        camera_matrix: NDArray[np.float64] | None = None,
    ) -> LabelMosaic:
        """Return a mosaic of probabilities, which reuses the memory of an earlier one."""
        spare = None
        with suppress(IndexError):
            spare = self._spare.pop()
        mosaic = LabelMosaic(
            self, shape, blend, averaged=averaged or self.min_share > 0, device=device, spare=spare
        )
        mosaic.valid = valid
        if not isinstance(mosaic.sums, np.memmap):  # space on the disk is released at once
            weakref.finalize(mosaic, self._spare.append, mosaic.sums).atexit = False
        return mosaic

    def crop_pixels(self, outputs: Tensor, ray_lengths: Tensor) -> Tensor:
        """Return the labels of the largest logits."""
        return self.labels_of(outputs.argmax(dim=1))

    def labels_of(self, best: Tensor) -> Tensor:
        """Return the labels of outputs: 0 where the best one belongs to none of the K classes."""
        if best.dtype == torch.uint16:  # torch has few operations on it
            return self.labels_of(best.int()).to(torch.uint16)
        return (best + 1).where(best < len(self.class_names) - 1, 0)

    # Pictures and files

    def panel(self, rgb: RGB, truth: NDArray[Any], prediction: NDArray[Any]) -> RGB:
        """Draw input, ground truth, prediction and error in a 2 × 2 grid above a legend."""
        return prediction_panel(rgb, truth, prediction, self.class_names)

    def note(self, prediction: Tensor, truth: Tensor) -> str:
        """Return the mIoU of one image; "" without labeled pixels."""
        if not truth.any():
            return ""
        counts = count_image(prediction.cpu(), truth.cpu(), len(self.class_names)).pixels
        return f"mIoU {100 * segmentation_scores(counts).means['miou']:.1f}\u00a0%"

    def count(self, mosaics: Iterable[Any]) -> str:
        """Find the confidence that pixels of each class need for `min_share`.

        One threshold for all classes keeps few pixels of rare classes, whose confidence is lower.
        The threshold of a class is a quantile of its confidences, as in class-balanced
        self-training (Zou et al., ECCV 2018).
        """
        if not self.min_share:
            return ""
        counts = np.zeros((len(self.class_names), _BINS), np.int64)
        for mosaic in mosaics:
            valid = ... if mosaic.valid is None else mosaic.valid
            labels, confidences = mosaic.pixels().cpu().numpy(), mosaic.confidences()
            count = len(self.class_names) - 1
            counts += count_confidences(labels[valid], confidences[valid], count)
        self.thresholds = class_thresholds(counts, self.min_confidence, self.min_share)
        least = zip(self.class_names[1:], self.thresholds[1:], strict=True)
        listed = ", ".join(f"{name} {confidence:.2f}" for name, confidence in least)
        return f"Smallest confidence of each class: {listed}."

    def predicted(
        self, mosaic: Any, image: Any, files: Mapping[str, Path] = MappingProxyType({})
    ) -> PredictedImage:
        """Return the labels of an image; write the probabilities, which take much memory."""
        if "probabilities" in files:
            everywhere = np.arange(mosaic.shape[0]), np.arange(mosaic.shape[1])
            rows, columns = everywhere if image.area is None else image.area.places()
            shape = (len(rows), len(columns), len(self.class_names) - 1)
            with array_file(files["probabilities"], shape, np.float16) as array:
                for start in range(0, len(rows), _ROWS_AT_ONCE):
                    part = slice(start, start + _ROWS_AT_ONCE)
                    probabilities = mosaic.probabilities(rows[part]).cpu().numpy()
                    array[part] = probabilities[:, columns, : shape[-1]]
        return super().predicted(mosaic, image, files)

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

    def read(self, file: Path) -> NDArray[Any]:
        """Read labels."""
        return read_pixels(file, indices=True)

    def painter(self, kind: str, summaries: Sequence[Any]) -> Painter:
        """Color the labels, or overlay the frame with them."""
        count = len(self.class_names)
        if kind == "color":
            return lambda rgb, labels: colorize(labels, count)
        return lambda rgb, labels: mixed_picture(rgb, labels, count)

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return the share of the solid angle of each class; 0 if everything is masked."""
        labels, count = predicted.pixels, len(self.class_names)
        total, mask = np.zeros(count), np.broadcast_to(is_counted, labels.shape)
        for line, weights, counted in zip(labels, solid_angles(predicted), mask, strict=True):
            total += np.bincount(line, weights * counted, minlength=count)
        shares = dict.fromkeys(self.class_names, 0.0)  # another class may be called unknown too
        for name, share in zip(self.class_names, total / (total.sum() or 1), strict=True):
            shares[name] += float(share)
        return shares

    def table(self, summaries: Sequence[Any]) -> SummaryTable:
        """Return the mean shares of the classes that occur, sorted."""
        count = max(1, len(summaries))
        mean = {name: sum(of[name] for of in summaries) / count for name in self.class_names}
        seen = sorted(filter(mean.get, mean), key=mean.__getitem__, reverse=True)
        rows = [[name, f"{100 * mean[name]:.1f}"] for name in seen]
        return SummaryTable("Mean over the images", ["class", "solid angle, %"], rows)


class LabelMosaic(ScoreMosaic):
    """Probabilities of classes, from which `pixels` are the labels.

    Args:
        head: Classes, and the confidence that their pixels need.
        shape: See `ScoreMosaic`.
        blend: See `ScoreMosaic`.
        **settings: See `ScoreMosaic`.

    Attributes:
        valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
    """

    facts: Mapping[str, Any] = MappingProxyType({})
    valid: NDArray[np.bool_] | None = None

    def __init__(
        self, head: ClassesHead, shape: tuple[int, int], blend: Blend, **settings: Any
    ) -> None:
        least = 0.0 if head.min_share else head.min_confidence
        super().__init__(shape, head.num_outputs, blend, min_confidence=least, **settings)
        self._head = head

    def pixels(self) -> Tensor:
        """Return labels ``(H, W)``, 0 where unknown."""
        labels, thresholds = self._head.labels_of(self.labels()), self._head.thresholds
        if thresholds is None:
            return labels
        is_sure = self.confidences() >= thresholds[labels.cpu().numpy()]
        return labels.where(torch.from_numpy(is_sure).to(labels.device), 0)


def count_confidences(
    labels: NDArray[np.integer], confidences: NDArray[np.floating], num_classes: int
) -> NDArray[np.int64]:
    """Return ``(K + 1, bins)`` pixels of each label by confidence from 0 to 1.

    Args:
        labels: Labels from 0 to K.
        confidences: Confidence of each of them.
        num_classes: K.
    """
    place = np.minimum(confidences * _BINS, _BINS - 1).astype(np.int64)
    place += labels.astype(np.int64) * _BINS
    return np.bincount(place.ravel(), minlength=(num_classes + 1) * _BINS).reshape(-1, _BINS)


def class_thresholds(
    counts: NDArray[np.int64], most: float, min_share: float
) -> NDArray[np.float64]:
    """Return the confidence that pixels of each label need, ``(K + 1,)``.

    Args:
        counts: Result of `count_confidences`.
        most: Largest threshold, which labels without counted pixels have.
        min_share: Share of the counted pixels of each label that is kept at least.

    >>> counts = count_confidences(np.array([1, 1, 1, 1]), np.array([0.3, 0.5, 0.75, 0.95]), 2)
    >>> class_thresholds(counts, 0.9, 0.5).tolist()
    [0.9, 0.75, 0.9]
    """
    kept = counts[:, ::-1].cumsum(axis=1)[:, ::-1]  # at or above the lower edge of each bin
    is_enough = kept >= min_share * kept[:, :1]
    return np.minimum((is_enough.sum(axis=1) - 1) / _BINS, most)
