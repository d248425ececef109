"""Semantic segmentation of panoramas and photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from jaxtyping import Float, Integer
from numpy.typing import NDArray
from torch import Tensor, nn

from datamodules.core.class_weights import ClassWeights
from datamodules.core.labels import PIXEL_CLASSES
from datamodules.core.samples import EvaluationSample, valid_mask
from tangent_train.errors import SettingError
from tangent_train.inference.engine import scored_views, view_scores
from tangent_train.metrics.score_columns import ScoreColumn, by_solid_angle, with_solid_angle
from tangent_train.metrics.segmentation import (
    AbsentClass,
    SegmentationCounts,
    SegmentationMetric,
    SegmentationScores,
    bootstrap_intervals,
    count_image,
    mean_scores,
    segmentation_scores,
)
from tangent_train.rendering.checks import check_choice
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.results.evaluation import class_entries, latitude_entries
from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.html.page import EncodedImage, encode_image
from tangent_train.results.pictures import prediction_panel, shown_arrays
from tangent_train.results.tables import percent
from tangent_train.tasks.base import RGB
from tangent_train.tasks.losses import auxiliary_sum, cross_entropy_norm, cross_entropy_sum
from tangent_train.tasks.views import ViewsTask, labels_of_views


class SegmentationTask(ViewsTask):
    """Trains a network on views of panoramas, or on crops of photos, and scores whole images.

    The loss is the sum over the labeled pixels of all views of a step, divided by the sum of the
    class weights of these pixels. Validation and test cover the whole sphere, or the whole photo;
    the scores are rendered back and compared with the original labels.

    Args:
        network: Network, see `ViewsTask`. Score k is that of label k + 1.
        *arguments: Representation, names of the K + 1 labels (the unknown class first), optimizer
            and scheduler, see `Task`.
        class_weights: Weights of the loss: a name (``none``, ``log``, ``sqrt``), for weights that
            the data module computes, or K numbers.
        absent_class: Treatment of classes absent from the ground truth in the means.
        **settings: Further arguments of `ViewsTask`.
    """

    predicts: ClassVar[str] = PIXEL_CLASSES
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "macc": ScoreColumn("mAcc", "%", "accuracy", "accuracy"),
            "miou": ScoreColumn("mIoU", "%", "iou", "IoU"),
        }
    )
    monitor: ClassVar[str] = "val/miou"
    takes: ClassVar[str] = "images (n, C, h, w) to scores of every pixel (n, K, h, w)"
    class_weights: Tensor

    def __init__(
        self,
        network: nn.Module,
        *arguments: Any,
        class_weights: ClassWeights | Sequence[float] = "log",
        absent_class: AbsentClass = "skip",
        **settings: Any,
    ) -> None:
        super().__init__(network, *arguments, **settings)
        check_choice("task.absent_class", absent_class, get_args(AbsentClass))
        names, classes = get_args(ClassWeights), self.class_names[1:]
        is_name = isinstance(class_weights, str)
        if not (class_weights in names if is_name else len(class_weights) == len(classes)):
            expected = f"{', '.join(names)}; or {len(classes)} numbers, for {', '.join(classes)}"
            raise SettingError("task.class_weights", found=class_weights, expected=expected)
        self.weighting = class_weights
        self.absent_class: AbsentClass = absent_class
        self.register_buffer("class_weights", torch.ones(len(classes)))

    def setup(self, stage: str) -> None:
        """Set the class weights before training; a checkpoint contains its weights."""
        if stage != "fit" or self.trainer.ckpt_path:
            return
        weights: Any = self.weighting
        if isinstance(weights, str):
            weights = self.trainer.datamodule.class_weights(weights)  # type: ignore[attr-defined]
        self.class_weights.copy_(torch.as_tensor(weights, dtype=torch.float32))

    @property
    def num_scores(self) -> int:
        """Number of scores: that of classes, plus one for unknown classes of imported networks."""
        count: int = getattr(self.network, "num_scores", len(self.class_weights))
        return count

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Return the weighted cross-entropy, summed over pixels, including auxiliary scores."""
        outputs, weights = self.outputs(*inputs), self.class_weights
        loss = cross_entropy_sum(outputs["out"], labels, weights, self.label_smoothing)
        if "aux" not in outputs:
            return loss
        return loss + self.auxiliary_weight * auxiliary_sum(outputs["aux"], labels, weights)

    def loss_norm(self, labels: Tensor) -> Tensor:
        """Return the sum of the class weights of the labeled pixels."""
        return cross_entropy_norm(labels, self.class_weights)

    @torch.no_grad()
    def predict_labels(
        self,
        images: Float[Tensor, "images channels height width"],
        shape: tuple[int, ...],
        rotation: NDArray[np.float64] | None = None,
        target: Tensor | None = None,
        valid: NDArray[np.bool_] | None = None,
    ) -> Integer[Tensor, ...]:
        """Predict the label of every pixel of one panorama, or of the crops of a photo.

        Args:
            images: Images of all view sets of the representation, in this order.
            shape: Shape of the ground truth: ``(H, W)`` of the panorama, or ``(n, h, w)`` of the
                crops.
            rotation: Rotation of the representation ``(3, 3)``.
            target: Ground truth, to add to the validation loss; None to compute no loss.
            valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.

        Returns:
            Labels of that shape from 1 to K; 0 where an imported network predicts none of the
            classes. Labels of invalid pixels have no meaning.
        """
        if len(shape) > 2:  # crops, each separately
            best = images.new_empty(shape, dtype=torch.int64)
            for part, scores in view_scores(
                self, images.__getitem__, len(images), self.eval_view_batch_size
            ):
                best[part] = scores.argmax(dim=1)
                if target is not None:
                    self._add_loss(scores, target[part])
        else:
            sets, blend = self.view_sets(images, rotation, valid), self.representation.blend
            how: Any = {"averaged": len(sets) > 1, "device": images.device}
            mosaic = ScoreMosaic((shape[0], shape[1]), self.num_scores, blend, **how)
            for views, scores in scored_views(self, sets, self.eval_view_batch_size):
                mosaic.add(scores, views)
                if target is not None:
                    self._add_loss(scores, labels_of_views(target, views))
            best = mosaic.labels().long().to(images.device)
        return (best + 1).where(best < len(self.class_weights), 0)

    def _add_loss(self, scores: Tensor, labels: Tensor) -> None:
        """Add the cross-entropy of views, without auxiliary scores, to the validation loss."""
        loss = cross_entropy_sum(scores, labels, self.class_weights, self.label_smoothing)
        self.add_validation_loss(loss, labels)

    def predict_sample(self, sample: EvaluationSample[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the predicted and the true labels, see `ViewsTask`."""
        rotation, shape = sample.rotation.cpu().numpy(), tuple(sample.target.shape)
        valid = valid_mask(sample.valid)
        target = None if self.is_tested else sample.target
        return self.predict_labels(sample.images, shape, rotation, target, valid), sample.target

    def build_metric(self) -> SegmentationMetric:
        """Build the confusion matrices of pixels, latitude bands and solid angles."""
        return SegmentationMetric(len(self.class_names))

    def logged_scores(self, result: SegmentationCounts) -> dict[str, float]:
        """Return means over classes; for panoramas, also weighted by solid angle."""
        pixels, angles = self._scores(result)
        return pixels.means | (by_solid_angle(angles.means) if result.solid_angle.any() else {})

    def class_scores(self, result: SegmentationCounts) -> dict[str, float]:
        """Return the intersection over union of each class."""
        scores = self._scores(result)[0].iou.tolist()
        return {f"iou/{n}": s for n, s in zip(self.class_names[1:], scores, strict=True)}

    def evaluation_result(self, result: SegmentationCounts, noun: str) -> EvaluationResult:
        """Return the record with scores of classes and latitude bands, and confidence intervals."""
        pixels, angles = self._scores(result)
        of_images, absent = result.of_images.swapaxes(0, 1), self._absent_classes(result)
        intervals = list(map(bootstrap_intervals, of_images, absent))
        columns = pixels.of_classes | by_solid_angle(angles.of_classes) | {"share": pixels.share}
        return replace(
            super().evaluation_result(result, noun),
            classes=class_entries(columns, result.pixels, self.class_names),
            latitude_bands=latitude_entries(
                segmentation_scores(band, self.absent_class if band.any() else "skip").means
                for band in result.bands
            )
            if result.solid_angle.any()
            else (),
            confusion=result.pixels.tolist(),
            intervals=intervals[0] | by_solid_angle(intervals[1]),
        )

    @property
    def facts(self) -> dict[str, str]:
        """See `Task`: the scores count pixels of all images together, then average classes."""
        return {"absent_class": self.absent_class, "weighting": "pixels"}

    def scores_of(self, result: SegmentationCounts, places: Sequence[int]) -> dict[str, float]:
        """See `Task`: mIoU and mAcc, of panoramas also by solid angle."""
        sums = result.of_images[list(places)].sum(axis=0)
        pixels, angles = map(mean_scores, sums, self._absent_classes(result))
        scores = pixels | (by_solid_angle(angles) if result.solid_angle.any() else {})
        return {name: float(score) for name, score in scores.items()}

    def _absent_classes(self, result: SegmentationCounts) -> tuple[AbsentClass, AbsentClass]:
        """Return the treatment of absent classes for scores by pixels and by solid angle."""
        return self.absent_class, self.absent_class if result.solid_angle.any() else "skip"

    def _scores(self, result: SegmentationCounts) -> Sequence[SegmentationScores]:
        """Return scores by pixels and by solid angle."""
        matrices = result.pixels, result.solid_angle
        return tuple(map(segmentation_scores, matrices, self._absent_classes(result)))

    def picture(
        self, image: Any, target: Tensor, prediction: Tensor, most_rows: int | None = None
    ) -> RGB:
        """Draw input, ground truth, prediction and error in a 2 × 2 grid above a legend."""
        shown = shown_arrays(image, target, prediction, self.representation, most_rows)
        return prediction_panel(*shown, self.class_names)

    def report_image(
        self, name: str, image: Any, target: Tensor, prediction: Tensor
    ) -> EncodedImage:
        """Return the image with its true and predicted labels."""
        rgb, truth, labels = shown_arrays(image, target, prediction, self.representation, cut=False)
        classes = len(self.class_names)
        counts = count_image(prediction.cpu(), target.cpu(), classes).pixels
        note = f"mIoU {percent(segmentation_scores(counts).miou)}\u00a0%" if truth.any() else ""
        return encode_image(
            name, rgb, classes, prediction=labels, truth=truth, sphere=target.ndim == 2, note=note
        )
