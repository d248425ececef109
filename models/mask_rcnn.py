"""Mask R-CNN of torchvision as a network of classes and objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.segments import Segments, front_segments

MASK_RCNNS = "maskrcnn_resnet50_fpn", "maskrcnn_resnet50_fpn_v2"
"""Names of the networks in torchvision."""

_INSIDE = 0.5
"""Probability above which a pixel belongs to an object."""


class MaskRCNN(nn.Module):
    """Mask R-CNN (He et al., ICCV 2017) with random weights.

    The probability of a class is the largest product of score and mask of its objects; that of the
    last output, "none of the classes", is 1 minus the largest of these.

    Args:
        model: One of `MASK_RCNNS`.
        num_labels: Number of labels of the network, with the background, label 0.
        labels: Label of each class; objects of other labels are left out.
        threshold: Score above which objects are returned.
        **settings: Further settings of ``torchvision.models.detection.MaskRCNN``, e.g.
            ``image_mean`` and ``image_std``, with which the network normalizes images.
    """

    def __init__(
        self,
        model: str,
        num_labels: int,
        labels: Sequence[int],
        threshold: float = 0.5,
        **settings: Any,
    ) -> None:
        super().__init__()
        from torchvision.models import get_model  # seconds to import

        self._labels, self._threshold = list(labels), threshold
        given = {"weights": None, "weights_backbone": None, "num_classes": num_labels} | settings
        self.network = get_model(model, **given)
        if model == MASK_RCNNS[0]:  # its published weights were trained so
            for module in self.network.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eps = 0.0

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Any]:
        """Return probabilities ``(batch, K + 1, height, width)`` and a list of `Segments`.

        Args:
            images: RGB images from 0 to 1.
        """
        size = images.shape[-2:]
        transform = self.network.transform  # images keep their size
        transform.min_size, transform.max_size = (min(size),), max(size)
        # One by one: masks of 100 objects of an image are large.
        found = [self._of_image(self.network([image])[0]) for image in images]
        shares, segments = zip(*found, strict=True)
        return {"out": torch.stack(shares), "segments": list(segments)}

    def _of_image(self, found: dict[str, Tensor]) -> tuple[Tensor, Segments]:
        """Return the probabilities ``(K + 1, h, w)`` and objects of an image."""
        is_class = found["labels"][:, None] == found["labels"].new_tensor(self._labels)
        kept, classes = is_class.nonzero().unbind(1)
        scores, masks = found["scores"][kept], found["masks"][kept, 0]
        shares = masks.new_zeros(len(self._labels), *masks.shape[1:])
        for k in set(classes.tolist()):
            of_class = classes == k
            shares[k] = (scores[of_class, None, None] * masks[of_class]).amax(0)
        best = scores > self._threshold
        segments = front_segments(masks[best] > _INSIDE, classes[best], scores[best])
        return torch.cat([shares, 1 - shares.amax(0, keepdim=True)]), segments
