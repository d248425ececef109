"""Depth of panoramas and photos: the distance from the center at every pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from datamodules.core.images import STEPS_PER_M
from datamodules.core.labels import DISTANCE
from datamodules.core.samples import EvaluationSample, valid_mask
from tangent_train.checkpoints.distances import (
    along_rays,
    depth_of_output,
    distance_of,
    from_distance,
    is_disparity,
    is_metric,
)
from tangent_train.checkpoints.kinds import Align, DepthKind
from tangent_train.errors import SettingError
from tangent_train.inference.depth import check_align, combine_depth
from tangent_train.inference.engine import scored_views, view_scores
from tangent_train.metrics.depth import (
    Alignment,
    DepthMetric,
    DepthProtocol,
    Quantity,
    depth_intervals,
    error_sums,
    mean_depth_scores,
    scaled_and_shifted,
)
from tangent_train.metrics.score_columns import ScoreColumn, by_solid_angle, with_solid_angle
from tangent_train.rendering.checks import check_choice
from tangent_train.results.evaluation import latitude_entries
from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.html.page import EncodedImage, encode_image
from tangent_train.results.pictures import distance_panel, shown_arrays
from tangent_train.tasks.base import RGB
from tangent_train.tasks.losses import DepthLoss, log_error_sum
from tangent_train.tasks.views import ViewsTask, labels_of_views

_LEAST = 1e-3
"""Smallest depth, in meters, or disparity whose logarithm is taken in the loss."""


class DepthTask(ViewsTask):
    """Trains a network that predicts distances, and scores whole panoramas or photos.

    The loss is a sum over the pixels of a step whose distance is known, divided by their number.
    Validation and test align the views of a panorama with each other, and compare the distances of
    the panorama with the true ones, which are the labels of the data.

    Args:
        network: Network with one output, see `ViewsTask`: the natural logarithm of the distance, or
            `depth_kind`.
        *arguments: Representation, no class names, optimizer and scheduler, see `Task`.
        depth_kind: Kind of the network's output; None for that of a network from a file, else
            ``log_distance``.
        loss: Kind of loss, see `log_error_sum`.
        scale_invariance: λ of the loss `scale_invariant`.
        align: Alignment of the views of a panorama with each other, see `inference.alignment`; None
            for the usual one of `depth_kind`.
        alignment: See `DepthProtocol`.
        alignment_in: See `DepthProtocol`; None for the quantity in which the network predicts.
        min_distance: See `DepthProtocol`; pixels beyond the limits are ignored in training too.
        max_distance: See `DepthProtocol`.
        clip: See `DepthProtocol`.
        **settings: Further arguments of `ViewsTask`.

    Attributes:
        result: Sums ``(images, 8, 10)`` of the last evaluation, see `error_sums`.
        views_aligned: Alignment of the views of the last panorama with each other; None before the
            first panorama, and for photos.
    """

    labels: ClassVar[str] = DISTANCE
    predicts: ClassVar[str] = DISTANCE
    columns: ClassVar[Mapping[str, ScoreColumn]] = with_solid_angle(
        {
            "absrel": ScoreColumn("AbsRel", "", better="lower"),
            "delta1": ScoreColumn("δ1"),
            "rmse": ScoreColumn("RMSE", "m", better="lower"),
            "mae": ScoreColumn("MAE", "m", better="lower", is_main=False),
            "sqrel": ScoreColumn("SqRel", "m", better="lower", is_main=False),
            "rmse_log": ScoreColumn("RMSElog", "", better="lower", is_main=False),
            "delta2": ScoreColumn("δ2", is_main=False),
            "delta3": ScoreColumn("δ3", is_main=False),
            "missing": ScoreColumn("missing", better="lower", is_main=False),
        }
    )
    monitor: ClassVar[str] = "val/absrel"
    takes: ClassVar[str] = "images (n, C, h, w) to one number for every pixel (n, 1, h, w)"
    num_scores = 1

    def __init__(
        self,
        network: nn.Module,
        *arguments: Any,
        depth_kind: DepthKind | None = None,
        loss: DepthLoss = "log_l1",
        scale_invariance: float = 0.5,
        align: Align | None = None,
        alignment: Alignment = "none",
        alignment_in: Quantity | None = None,
        min_distance: float = 0.0,
        max_distance: float | None = None,
        clip: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__(network, *arguments, **settings)
        of_file = getattr(network, "kind", None)
        self.depth_kind: DepthKind = depth_kind or of_file or "log_distance"
        kinds = (of_file,) if of_file else get_args(DepthKind)
        check_choice("task.depth_kind", self.depth_kind, kinds)
        check_align("task.align", align, self.representation)
        check_choice("task.loss", loss, get_args(DepthLoss))
        if not 0 <= scale_invariance <= 1:
            raise SettingError("task.scale_invariance", found=scale_invariance, expected="0 to 1")
        if self.label_smoothing:
            raise SettingError("task.label_smoothing", found=self.label_smoothing, expected="0")
        if alignment == "none" and not is_metric(self.depth_kind):
            raise SettingError(
                "task.alignment",
                found=f"none, for a network that predicts {self.depth_kind}",
                expected="median, scale or affine: the scale of its distances is unknown",
                remedy="task.alignment=affine",
            )
        quantity = alignment_in or ("disparity" if is_disparity(self.depth_kind) else "distance")
        self.protocol = DepthProtocol(alignment, quantity, min_distance, max_distance, clip)
        self.loss: DepthLoss = loss
        self.scale_invariance = scale_invariance
        self.align = align
        self.views_aligned: Align | None = None

    @staticmethod
    def num_outputs(num_classes: int) -> int:
        """See `Task`: one output."""
        return 1

    def meters(self, labels: Tensor) -> Float[Tensor, "*shape"]:
        """Return true distances in meters; NaN where they are unknown or beyond the limits.

        Args:
            labels: Distances in steps of 1/512 m, 0 where unknown.
        """
        return self.protocol.limited(labels.float() / STEPS_PER_M)

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return all images of a batch, and the output ``(n, h, w)`` that would be correct."""
        images, labels = super().training_pairs(batch)
        lengths = batch.ray_lengths.expand(*batch.labels.shape[:2], *batch.ray_lengths.shape[-2:])
        truth = self.meters(labels)
        return images, from_distance(truth, self.depth_kind, lengths.flatten(0, 1))

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Return the loss, summed over pixels, including that of an auxiliary head."""
        outputs = self.outputs(*inputs)
        loss = self._loss(outputs["out"], labels)
        if "aux" not in outputs:
            return loss
        enlarged = functional.interpolate(outputs["aux"], labels.shape[-2:], mode="bilinear")
        return loss + self.auxiliary_weight * self._loss(enlarged, labels)

    def _loss(self, outputs: Tensor, truth: Tensor) -> Tensor:
        """Return the loss of outputs ``(n, 1, h, w)``, given the correct ones ``(n, h, w)``."""
        return log_error_sum(self.errors(outputs, truth), self.loss, self.scale_invariance)

    def errors(
        self, outputs: Float[Tensor, "images 1 height width"], truth: Tensor
    ) -> Float[Tensor, "images height width"]:
        """Return the errors of the logarithm of the network's depth, or disparity.

        Relative outputs are first scaled and shifted, see `scaled_and_shifted`.

        Args:
            outputs: Outputs of the network.
            truth: The correct outputs ``(n, h, w)``; NaN where unknown.
        """
        values = outputs[:, 0].to(truth.dtype)  # float32 in half-precision training
        if self.depth_kind == "log_distance":
            return values - truth
        if not is_metric(self.depth_kind):
            values = scaled_and_shifted(values, truth)
        return values.clamp(min=_LEAST).log() - truth.log()

    def loss_norm(self, labels: Tensor) -> Tensor:
        """Return the number of pixels whose distance is known."""
        return (~labels.isnan()).sum().float()

    def _add_loss(self, outputs: Tensor, truth: Tensor, ray_lengths: Tensor) -> None:
        """Add the loss of views, given their true distances, to the validation loss."""
        labels = from_distance(truth, self.depth_kind, ray_lengths)
        self.add_validation_loss(self._loss(outputs, labels), labels)

    def predict_sample(self, sample: EvaluationSample[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the aligned and the true distances, see `ViewsTask`; NaN where unknown."""
        truth = self.meters(sample.target)
        if truth.ndim == 2:
            return self.protocol.aligned(self._of_panorama(sample, truth), truth), truth
        lengths = sample.ray_lengths
        parts = view_scores(self, sample.images.__getitem__, len(truth), self.eval_view_batch_size)
        depth = torch.cat([scores for _, scores in parts])
        if not self.is_tested:
            self._add_loss(depth, truth, lengths)
        values, kind = depth_of_output(depth, self.depth_kind, lengths[:, None])
        distances = distance_of(along_rays(values, kind, lengths[:, None]), kind)[:, 0]
        # The crops of a photo have separate scales.
        crops = zip(distances, truth, lengths, strict=True)
        return torch.stack([self.protocol.aligned(*crop) for crop in crops]), truth

    def _of_panorama(
        self, sample: EvaluationSample[Tensor], truth: Tensor
    ) -> Float[Tensor, "height width"]:
        """Predict the distances of a panorama from its views, which are aligned with each other."""
        valid = valid_mask(sample.valid)
        sets = self.view_sets(sample.images, sample.rotation.cpu().numpy(), valid)
        outputs = list(scored_views(self, sets, self.eval_view_batch_size))
        for views, depth in [] if self.is_tested else outputs:
            lengths = torch.from_numpy(views.ray_lengths()).to(depth.device)
            self._add_loss(depth, labels_of_views(truth, views), lengths)
        shape, blend = (truth.shape[0], truth.shape[1]), self.representation.blend
        combined = combine_depth(outputs, shape, self.depth_kind, blend, self.align, valid=valid)
        self.views_aligned = combined.report.mode
        return combined.distance.to(truth.device)

    def build_metric(self) -> DepthMetric:
        """Build the metric, which keeps the sums of the errors of each image."""
        return DepthMetric()

    def logged_scores(self, result: NDArray[np.float64]) -> dict[str, float]:
        """Return means over images; for panoramas, also weighted by solid angle."""
        pixels, angles = (mean_depth_scores(result[:, weighting]) for weighting in (0, 1))
        return pixels | (by_solid_angle(angles) if result[:, 1].any() else {})

    def evaluation_result(self, result: NDArray[np.float64], noun: str) -> EvaluationResult:
        """Return the record with scores of latitude bands, and confidence intervals."""
        return replace(
            super().evaluation_result(result, noun),
            latitude_bands=latitude_entries(map(mean_depth_scores, result[:, 2:].swapaxes(0, 1)))
            if result[:, 1].any()
            else (),
            intervals=depth_intervals(result[:, 0]) | by_solid_angle(depth_intervals(result[:, 1])),
        )

    @property
    def facts(self) -> dict[str, str]:
        """See `Task`: errors are those of the pixels of an image, averaged over the images.

        The alignment of views is known after an evaluation on panoramas.
        """
        views = {} if self.views_aligned is None else {"views_aligned": self.views_aligned}
        return {"weighting": "pixels, then images", **self.protocol.facts, **views}

    def picture(
        self, image: Any, target: Tensor, prediction: Tensor, most_rows: int | None = None
    ) -> RGB:
        """Draw input, true and predicted distance, and error in a 2 × 2 grid."""
        truth = self.meters(target)
        shown = shown_arrays(image, truth, prediction, self.representation, most_rows)
        return distance_panel(*shown)

    def report_image(
        self, name: str, image: Any, target: Tensor, prediction: Tensor
    ) -> EncodedImage:
        """Return the image with its true and predicted distances, aligned as for the scores."""
        truth = self.meters(target)
        sums = error_sums(prediction, truth)[:1].cpu().numpy()
        absrel = mean_depth_scores(sums)["absrel"]
        note = "" if np.isnan(absrel) else f"AbsRel {absrel:.3g}"
        rgb, true, shown = shown_arrays(image, truth, prediction, self.representation, cut=False)
        sphere = target.ndim == 2
        return encode_image(name, rgb, prediction=shown, truth=true, sphere=sphere, note=note)

    def scores_of(self, result: NDArray[np.float64], places: Sequence[int]) -> dict[str, float]:
        """See `Task`; NaN if the images have no known distances."""
        undefined = dict.fromkeys(self.logged_scores(result), np.nan)
        return undefined | self.logged_scores(result[list(places)])
