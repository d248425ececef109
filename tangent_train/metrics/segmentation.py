"""One confusion matrix over the data set, and the scores read from it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Integer
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchmetrics import Metric

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_latitudes, equirect_solid_angles

__all__ = [
    "BAND_EDGES_DEG",
    "UNKNOWN",
    "AbsentClass",
    "ConfusionMatrices",
    "ConfusionMatrix",
    "SegmentationScores",
    "segmentation_scores",
]

AbsentClass = Literal["skip", "zero"]
"""Whether a class without labelled pixels is left out of a mean or counts as 0."""

UNKNOWN = 0
"""Class index of unlabelled pixels, everywhere."""

BAND_EDGES_DEG = (90, 60, 30, 0, -30, -60, -90)
"""Latitude bands, from north to south."""

_PANORAMA_DIMENSIONS = 2


class SegmentationScores(NamedTuple):
    """Scores of one confusion matrix; classes in order, the unknown class left out.

    Attributes:
        miou: Mean of `iou`.
        macc: Mean of `accuracy`.
        iou: ``(K,)`` intersection over union; NaN for absent classes that are skipped.
        accuracy: ``(K,)`` share of a class's pixels that were found.
        share: ``(K,)`` share of the labelled pixels that a class has.
    """

    miou: float
    macc: float
    iou: NDArray[np.float64]
    accuracy: NDArray[np.float64]
    share: NDArray[np.float64]


def segmentation_scores(
    confusion: ArrayLike, absent_class: AbsentClass = "skip"
) -> SegmentationScores:
    """Scores of a whole data set.

    Args:
        confusion: ``(K+1, K+1)`` counts or weights, rows truth, columns prediction, class 0 unknown
            (pixels without ground truth are ignored).
        absent_class: `skip` leaves classes absent from the ground truth out of the means; `zero`
            counts them as 0, as the released code does.

    Returns:
        The scores; means are NaN when nothing is labelled and absent classes are skipped.
    """
    matrix = np.asarray(confusion, np.float64)[1:]
    truth, hits = matrix.sum(axis=1), matrix[:, 1:].diagonal()
    predicted = matrix[:, 1:].sum(axis=0)
    present = truth > 0
    missing = np.nan if absent_class == "skip" else 0.0
    iou = np.full(len(truth), missing)
    accuracy = iou.copy()
    iou[present] = (hits / np.maximum(truth + predicted - hits, 1e-300))[present]
    accuracy[present] = hits[present] / truth[present]
    used = present | (absent_class == "zero")
    miou, macc = (float(v[used].mean()) if used.any() else np.nan for v in (iou, accuracy))
    share = truth / truth.sum() if present.any() else np.zeros_like(truth)
    return SegmentationScores(miou, macc, iou, accuracy, share)


class ConfusionMatrices(NamedTuple):
    """The counts of a `ConfusionMatrix`; rows truth, columns prediction, class 0 unknown.

    Attributes:
        pixels: ``(K+1, K+1)`` pixels of panoramas and photos.
        solid_angle: ``(K+1, K+1)`` steradians of panoramas; all 0 for photos.
        bands: ``(6, K+1, K+1)`` pixels of the latitude bands `BAND_EDGES_DEG`, likewise.
        images: Panoramas or photos counted.
    """

    pixels: NDArray[np.int64]
    solid_angle: NDArray[np.float64]
    bands: NDArray[np.int64]
    images: int


class ConfusionMatrix(Metric):
    """Confusion matrices: integer pixel counts, and of panoramas also by latitude and solid angle.

    ERP pixels over-count the poles; the matrix of solid angles weights every pixel by its own.
    All are summed over processes.

    Args:
        num_classes: K + 1, the unknown class 0 included.

    Attributes:
        pixels: ``(K+1, K+1)`` pixels; rows truth, columns prediction.
        bands: ``(6, K+1, K+1)`` pixels per latitude band of 30°, north first.
        steradians: ``(K+1, K+1)`` the same over all latitudes, in steradians.
        images: Panoramas and photos seen.
    """

    full_state_update = False
    pixels: Tensor
    bands: Tensor
    steradians: Tensor
    images: Tensor

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.num_classes = num_classes
        bands = len(BAND_EDGES_DEG) - 1
        square = (num_classes, num_classes)
        for name, default in (
            ("pixels", torch.zeros(square, dtype=torch.int64)),
            ("bands", torch.zeros((bands, *square), dtype=torch.int64)),
            ("steradians", torch.zeros(square, dtype=torch.float64)),
            ("images", torch.zeros((), dtype=torch.int64)),
        ):
            self.add_state(name, default, dist_reduce_fx="sum")

    def update(
        self,
        prediction: Integer[Tensor, "*shape"],
        truth: Integer[Tensor, "*shape"],
    ) -> None:
        """Count one panorama ``(H, W)``, or the crops of one photo ``(n, h, w)``.

        Args:
            prediction: Class indices.
            truth: Class indices; unknown (0) does not count.

        Raises:
            SettingError: The shapes differ or an index is out of range.
        """
        if prediction.shape != truth.shape:
            raise SettingError(
                "prediction", found=tuple(prediction.shape), expected=tuple(truth.shape)
            )
        k = self.num_classes
        known = truth != UNKNOWN
        pairs = _checked(truth[known], k) * k + _checked(prediction[known], k)
        self.images += 1
        if truth.ndim == _PANORAMA_DIMENSIONS:
            self._count_panorama(pairs, known)
        else:
            self.pixels += torch.bincount(pairs, minlength=k * k).reshape(k, k)

    def _count_panorama(self, pairs: Tensor, known: Tensor) -> None:
        k = self.num_classes
        rows = known.nonzero()[:, 0]
        height, width = known.shape
        latitudes = np.degrees(equirect_latitudes(height))
        band_of_row = np.searchsorted(-np.array(BAND_EDGES_DEG[1:-1]), -latitudes, side="left")
        # Integers first, sums of them after: the same figures in any order, on any device.
        by_row = torch.bincount(rows * k * k + pairs, minlength=height * k * k).reshape(
            height, k, k
        )
        self.pixels += by_row.sum(dim=0)
        self.bands.index_add_(0, torch.as_tensor(band_of_row, device=known.device), by_row)
        angles = torch.as_tensor(equirect_solid_angles((height, width)), device=known.device)
        self.steradians += torch.tensordot(angles, by_row.double(), dims=1)

    def compute(self) -> ConfusionMatrices:
        """The matrices of all processes, as arrays."""
        return ConfusionMatrices(
            pixels=self.pixels.cpu().numpy(),
            solid_angle=self.steradians.cpu().numpy(),
            bands=self.bands.cpu().numpy(),
            images=int(self.images),
        )


def _checked(indices: Tensor, num_classes: int) -> Tensor:
    least, greatest = map(int, indices.aminmax()) if indices.numel() else (0, 0)
    if least < 0 or greatest >= num_classes:
        raise SettingError(
            "class index", found=f"{least} to {greatest}", expected=f"0 to {num_classes - 1}"
        )
    return indices.long()
