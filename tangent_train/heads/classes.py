"""Heads for classes: a class for every pixel, or one for a whole shape."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, validate_call
from torch import Tensor
from torch.nn.functional import cross_entropy, pad

from datamodules.core.label_map import IMAGE_CLASS, PIXEL_CLASSES, ClassWeights
from tangent_train.heads import pictures
from tangent_train.heads.base import RGB, Head, PredictedImage, Scores
from tangent_train.io.palette import class_colors
from tangent_train.io.pixel_files import array_file, read_pixels
from tangent_train.metrics import segmentation
from tangent_train.metrics.image_sums import AbsentClass, Sums, class_scores, means_of_sums
from tangent_train.metrics.scores import (
    ScoreColumn,
    by_solid_angle,
    sphere_columns,
    with_solid_angle,
)
from tangent_train.metrics.segmentation import SegmentationCounts
from tangent_train.rendering import Blend
from tangent_train.rendering.mosaic import ScoreMosaic

_ROWS_AT_ONCE = 64


class ClassesHead(Head):
    """One of K classes for every pixel; output k of the network is the logit of label k + 1.

    The loss is the cross-entropy, weighted by class. The probabilities of overlapping views are
    averaged. All images are scored in one confusion matrix.

    Args:
        class_names: Names of the K + 1 labels, the unknown class first.
        class_weights: Weights of the loss: a name (``none``, ``log``, ``sqrt``), for weights that
            the data module computes, or K numbers.
        label_smoothing: Fraction of the target that is spread over all classes.
        absent_class: Treatment of classes absent from the ground truth in the means.
        min_confidence: Predicted pixels with a lower confidence, from 0 to 1, are unknown.
    """

    kind: ClassVar[str] = PIXEL_CLASSES
    labels: ClassVar[str] = PIXEL_CLASSES
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "macc": ScoreColumn("mAcc", "%", "accuracy", "accuracy"),
            "miou": ScoreColumn("mIoU", "%", "iou", "IoU"),
        }
    ) | {
        "boundary_miou": ScoreColumn("mIoU near boundaries", is_main=False, of_sphere=True),
        **sphere_columns("mIoU", labels="equal labels", miou="mIoU with the first labels"),
    }
    main_score: ClassVar[str] = "miou"
    predict_settings = MappingProxyType({"min_confidence": ""})
    summary: ClassVar[str] = "classes"
    suffixes = MappingProxyType(
        dict.fromkeys(("labels", "color", "overlay"), ".png") | {"probabilities": ".npy"}
    )
    class_weights: Tensor

    @validate_call
    def __init__(
        self,
        class_names: Sequence[str],
        class_weights: ClassWeights | Sequence[float] = "none",
        label_smoothing: float = 0.0,
        absent_class: AbsentClass = "skip",
        min_confidence: Annotated[float, Field(ge=0, le=1)] = 0.0,
    ) -> None:
        super().__init__(class_names)
        self.summary_columns = self.class_names
        self.num_outputs = len(self.class_names) - 1
        self.weighting, self.label_smoothing = class_weights, label_smoothing
        self.absent_class: AbsentClass = absent_class
        self.min_confidence = min_confidence
        self._spare: deque[NDArray[np.float32]] = deque(maxlen=1)
        self.register_buffer("class_weights", torch.ones(self.num_outputs))

    # Training

    def read_data(self, data: Any) -> None:
        """Set the class weights."""
        named = isinstance(self.weighting, str)
        weights: Any = data.class_weights(self.weighting) if named else self.weighting
        self.class_weights = torch.as_tensor(weights).to(self.class_weights)

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the weighted cross-entropy, summed over pixels; label 0 is ignored.

        Divided by the `loss_norm` of the same images, it is torch's weighted mean. Divided by the
        norm of *all* images, chunks and processes, it is the share of these images in one mean.
        """
        how: dict[str, Any] = {"reduction": "sum", "label_smoothing": self.label_smoothing}
        logits, labels = exact(outputs), targets.long() - 1
        weights = self.class_weights.to(logits)
        return cross_entropy(logits, labels, weights, ignore_index=-1, **how)

    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the sum of the class weights of the labeled pixels."""
        # Not with torch.bincount, for which the host waits for a GPU.
        label_weights = pad(exact(self.class_weights), (1, 0))
        return label_weights.index_select(0, targets.flatten().int()).sum()

    def auxiliary_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the weighted cross-entropy of pixels, with logits of a coarser stage.

        Each cell is compared with the class histogram of the pixels whose centers lie in it. This
        is the cross-entropy of the pixels, each with the logits of its cell, without upsampling;
        its norm is the `loss_norm` of the pixels.
        """
        logits = exact(outputs)
        images, classes, *size = outputs.shape
        rows, columns = (
            # The cell of every pixel center along a side.
            (2 * torch.arange(side, device=targets.device) + 1) * cells // (2 * side)
            for side, cells in zip(targets.shape[1:], size, strict=True)
        )
        image = torch.arange(images, device=targets.device)[:, None, None]
        cell = (image * size[0] + rows[:, None]) * size[1] + columns
        bins = (cell * (classes + 1) + targets).flatten()
        counts = logits.new_zeros(images * size[0] * size[1] * (classes + 1))
        counts.scatter_add_(0, bins, counts.new_ones(()).expand(bins.numel()))
        histograms = counts.view(images, *size, classes + 1)[..., 1:].movedim(-1, 1)
        # Counts instead of probabilities: pixels weigh the same in cells with few and many of them.
        weights = self.class_weights.to(logits)
        return cross_entropy(logits, histograms, weights, reduction="sum")

    # Scores

    def build_metric(self) -> Any:
        """Build the confusion matrices of pixels, latitude bands and solid angles."""
        from tangent_train.metrics.collected import SegmentationMetric  # seconds to import

        return SegmentationMetric(len(self.class_names))

    def scores(self, result: SegmentationCounts) -> Scores:
        """Return scores by pixels; for panoramas, also by solid angle and latitude."""
        score = partial(segmentation.segmentation_scores, absent_class=self.absent_class)
        bands = [
            (score(band) if band.any() else score(band, absent_class="skip")).means
            for band in result.bands
        ]
        sums = self.image_sums(result)
        means = means_of_sums(sums, self.absent_class)
        of_pixels = score(result.pixels)
        of_classes = of_pixels.of_classes
        if len(result.seam):
            steradians = sums["solid_angle"].sum(axis=0)
            of_classes |= by_solid_angle(class_scores(steradians, self.absent_class))
        of_classes |= {"share": of_pixels.share}
        return Scores(means, of_classes, bands if len(result.seam) else (), result.pixels)

    def image_sums(self, result: SegmentationCounts) -> Sums:
        """Return the counts of each image, of panoramas also by solid angle and region."""
        pixels, solid_angle = result.of_images.swapaxes(0, 1)
        of_sphere = {"solid_angle": solid_angle, "regions": result.regions, "seam": result.seam}
        return {"pixels": pixels, **(of_sphere if len(result.seam) else {})}

    def agreement(self, first: PredictedImage, other: PredictedImage) -> dict[str, float]:
        """Return the share of equal labels, and the mIoU over the classes of the first labels."""
        k, angles = len(self.class_names), first.solid_angles
        pairs = k * first.pixels.astype(np.int64) + other.pixels
        counts = np.bincount(pairs.ravel(), angles.ravel(), k * k).reshape(k, k)
        miou = segmentation.segmentation_scores(counts).means["miou"]
        equal = np.average(first.pixels == other.pixels, weights=angles)
        return {"labels": float(equal), "miou": miou}

    @property
    def facts(self) -> dict[str, str]:
        """The scores count pixels of all images together, then average classes."""
        return {"absent_class": self.absent_class, "weighting": "pixels"}

    # From views to a panorama

    def mosaic(
        self, shape: tuple[int, int], blend: Blend, *, averaged: bool = False, **settings: Any
    ) -> LabelMosaic:
        """Return a mosaic of probabilities, which reuses the memory of an earlier one."""
        spare = self._spare.pop() if self._spare else None
        mosaic = self._new_mosaic(shape, blend, averaged=averaged, spare=spare, **settings)
        if not isinstance(mosaic.sums, np.memmap):  # space on the disk is released at once
            weakref.finalize(mosaic, self._spare.append, mosaic.sums).atexit = False
        return mosaic

    def _new_mosaic(self, *given: Any, **settings: Any) -> LabelMosaic:
        return LabelMosaic(self, *given, **settings)

    def crop_pixels(self, outputs: Tensor, ray_lengths: Tensor) -> Tensor:
        """Return the labels of the largest logits; 0 where a logit is NaN or infinite."""
        highest, best = outputs.max(dim=1)
        return self.labels_of(best.where(highest.isfinite(), self.num_outputs))

    def labels_of(self, best: Tensor) -> Tensor:
        """Return the labels of outputs: 0 where the best one belongs to none of the K classes."""
        # torch has few operations on uint16.
        labels = (best.int() if best.dtype == torch.uint16 else best) + 1
        return labels.where(labels < len(self.class_names), 0).to(best.dtype)

    # Pictures and files

    def panel(self, rgb: RGB, truth: NDArray[Any], prediction: NDArray[Any]) -> RGB:
        """Draw input, ground truth, prediction and error in a 2 × 2 grid above a legend."""
        return pictures.prediction_panel(rgb, truth, prediction, self.class_names)

    def error(self, prediction: Tensor, truth: Tensor) -> tuple[float, str]:
        """Return 1 − mIoU of one image, and the mIoU; 0 and "" without labeled pixels."""
        if not truth.any():
            return 0.0, ""
        counts = segmentation.confusion(prediction.cpu(), truth.cpu(), len(self.class_names))
        miou = float(segmentation.segmentation_scores(counts).means["miou"])
        return 1 - miou, f"mIoU {100 * miou:.1f}\u00a0%"

    def write_mosaic(self, mosaic: Any, image: Any, files: Mapping[str, Path]) -> None:
        """Write the probabilities of an image, which take much memory."""
        if "probabilities" not in files:
            return
        everywhere = np.arange(mosaic.shape[0]), np.arange(mosaic.shape[1])
        rows, columns = everywhere if image.area is None else image.area.places()
        shape = (len(rows), len(columns), len(self.class_names) - 1)
        with array_file(files["probabilities"], shape, np.float16) as array:
            for start in range(0, len(rows), _ROWS_AT_ONCE):
                part = slice(start, start + _ROWS_AT_ONCE)
                probabilities = mosaic.probabilities(rows[part]).cpu().numpy()
                array[part] = probabilities[:, columns, : shape[-1]]

    def read(self, file: Path) -> NDArray[Any]:
        """Read labels."""
        return read_pixels(file, indices=True)

    def labels_in(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the labels of predicted pixels."""
        return pixels

    def paint(self, kind: str, rgb: RGB, pixels: NDArray[Any], limits: Any = None) -> RGB:
        """Color the labels, or overlay the image with them."""
        if kind == "color":
            return class_colors(self.class_names)[self.labels_in(pixels)]
        return pictures.mixed_picture(rgb, self.labels_in(pixels), self.class_names, pixels)

    def picture(self, kind: str, predicted: PredictedImage) -> RGB:
        """Return a picture; an overlay has a legend of the classes."""
        painted: RGB = super().picture(kind, predicted)
        if kind == "color":
            return painted
        labels = self.labels_in(predicted.pixels)
        return pictures.with_class_legend(painted, labels[labels > 0], self.class_names)

    def summarize(self, predicted: PredictedImage, is_counted: NDArray[np.bool_]) -> Any:
        """Return the share of the solid angle of each class; 0 if everything is masked."""
        labels, count = predicted.pixels, len(self.class_names)
        total, mask = np.zeros(count), np.broadcast_to(is_counted, labels.shape)
        for line, weights, counted in zip(labels, predicted.solid_angles, mask, strict=True):
            total += np.bincount(line, weights * counted, minlength=count)
        shares = dict.fromkeys(self.class_names, 0.0)  # another class may be called unknown too
        for name, share in zip(self.class_names, total / (total.sum() or 1), strict=True):
            shares[name] += float(share)
        return shares

    def table(self, summaries: Sequence[Any]) -> tuple[str, Sequence[str], list[list[str]]]:
        """Return the mean shares of the classes that occur, sorted."""
        count = max(1, len(summaries))
        mean = {name: sum(of[name] for of in summaries) / count for name in self.class_names}
        seen = sorted(filter(mean.get, mean), key=mean.__getitem__, reverse=True)
        rows = [[name, f"{100 * mean[name]:.1f}"] for name in seen]
        return "Mean over the images", ["class", "solid angle, %"], rows


class LabelMosaic(ScoreMosaic):
    """Probabilities of classes, from which `pixels` are the labels.

    Args:
        head: Classes, and the confidence that their pixels need.
        shape: See `ScoreMosaic`.
        blend: See `ScoreMosaic`.
        valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
        camera_matrix: Not used.
        **settings: See `ScoreMosaic`.
    """

    def __init__(
        self,
        head: ClassesHead,
        shape: tuple[int, int],
        blend: Blend,
        valid: NDArray[np.bool_] | None = None,
        camera_matrix: Any = None,
        **settings: Any,
    ) -> None:
        least = head.min_confidence
        super().__init__(shape, head.num_outputs, blend, min_confidence=least, **settings)
        self._head, self.valid = head, valid

    @property
    def facts(self) -> Mapping[str, Tensor]:
        """The share of pixels without a class, see `ScoreMosaic.not_finite`."""
        return {"not_finite": self.not_finite}

    def pixels(self) -> Tensor:
        """Return labels ``(H, W)``, 0 where unknown."""
        return self._head.labels_of(self.labels())


class ImageClassHead(Head):
    """One of K classes for a shape; output k of the network ``(n, K)`` is the logit of label k.

    Args:
        class_names: Names of the K classes.
        label_smoothing: Fraction of the target that is spread over all classes.
    """

    kind: ClassVar[str] = IMAGE_CLASS
    labels: ClassVar[str] = IMAGE_CLASS
    columns: ClassVar[Mapping[str, ScoreColumn]] = {
        "accuracy": ScoreColumn("accuracy"),
        "class_accuracy": ScoreColumn("mean over classes", "%", "accuracy", "accuracy"),
    }
    main_score: ClassVar[str] = "accuracy"

    def __init__(self, class_names: Sequence[str], label_smoothing: float = 0.0) -> None:
        super().__init__(class_names)
        self.num_outputs = len(self.class_names)
        self.label_smoothing = label_smoothing

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the cross-entropy, summed over the shapes."""
        smoothing = self.label_smoothing
        return cross_entropy(exact(outputs), targets, reduction="sum", label_smoothing=smoothing)

    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the number of shapes."""
        return torch.full((), float(len(targets)), device=targets.device)

    def build_metric(self) -> Any:
        """Build the confusion matrix of whole shapes."""
        from tangent_train.metrics.collected import ClassificationMetric  # seconds to import

        return ClassificationMetric(len(self.class_names))

    def scores(self, result: Any) -> Scores:
        """Return the accuracy over shapes, its mean over classes, and that of every class."""
        # With an unknown class, which no shape has.
        found = segmentation.segmentation_scores(np.pad(result, ((1, 0), (1, 0))))
        means = {"accuracy": np.trace(result) / result.sum(), "class_accuracy": found.means["macc"]}
        of_class = {"images": result.sum(axis=1), "accuracy": found.of_classes["accuracy"]}
        return Scores(means, of_class, confusion=result)


def exact(values: Tensor) -> Tensor:
    """Convert to at least float32, for sums over millions of pixels."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
