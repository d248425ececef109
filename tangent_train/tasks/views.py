"""Base class of tasks for every pixel of the views of panoramas and photos."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from datamodules.core.samples import EvaluationSample
from tangent_train.errors import SettingError, at_least
from tangent_train.inference.engine import sees_rays, upright_rays
from tangent_train.rendering import EquirectRepresentation, IcosphereRepresentation
from tangent_train.rendering.representations.views import Representation
from tangent_train.tasks.base import Part, Task

ViewSet = tuple[Any, Any, Tensor | None]
"""Views, a function that returns some of their images, and viewing rays for networks that take
them."""


class ViewsTask(Task):
    """Trains a network on views of panoramas, or on crops of photos, and scores whole images.

    The views of all images of a batch, on all processes, contribute to one gradient (paper,
    supplement, "Semantic segmentation").

    Args:
        network: Module ``(B, C, h, w) -> (B, K, h, w)``, or one that returns a dict with this
            output under ``"out"`` and optionally that of an auxiliary head under ``"aux"``. A
            network whose `forward` also takes ``rays`` and ``view_batch_size`` gets the viewing
            rays of its images and bounds its memory (`models.SphereContext`).
        representation: Representation of the images.
        *arguments: Class names, optimizer and scheduler, see `Task`.
        auxiliary_weight: Weight of the loss of the auxiliary output.
        eval_view_batch_size: Number of images per forward pass in evaluation, which bounds memory.
        **settings: Further arguments of `Task`.
    """

    def __init__(
        self,
        network: nn.Module,
        representation: Any,
        *arguments: Any,
        auxiliary_weight: float = 0.4,
        eval_view_batch_size: int = 32,
        **settings: Any,
    ) -> None:
        super().__init__(network, representation, *arguments, **settings)
        if not auxiliary_weight >= 0:
            expected = "0 or more"
            raise SettingError("task.auxiliary_weight", found=auxiliary_weight, expected=expected)
        self.sees_rays = sees_rays(network)
        whole = EquirectRepresentation | IcosphereRepresentation
        if self.sees_rays and isinstance(representation, whole):
            raise SettingError(
                "representation",
                found="one view of the whole sphere",
                expected="tangent images or a cube map for a network with cross-image context",
                remedy="Use the network without context.",
            )
        self.auxiliary_weight = auxiliary_weight
        self.eval_view_batch_size = at_least("task.eval_view_batch_size", eval_view_batch_size, 1)

    @property
    @abstractmethod
    def num_scores(self) -> int:
        """Number of outputs of the network at every pixel."""

    def forward(
        self,
        images: Float[Tensor, "images channels height width"],
        rays: Float[Tensor, "spheres of_each 3 3"] | None = None,
    ) -> Float[Tensor, "images outputs height width"]:
        """Return the output of the network at every pixel.

        Args:
            images: Images of one or several spheres.
            rays: Viewing rays, see `Views.rays`, for networks that take them.

        Raises:
            SettingError: The shape of the output does not fit the images or the labels.
        """
        return self.outputs(images, rays)["out"]

    def outputs(self, images: Tensor, rays: Tensor | None = None) -> Mapping[str, Tensor]:
        """Return all outputs of the network by name, see `forward`."""
        images = images.contiguous(memory_format=self.memory_format)
        if rays is None:
            returned = self.network(images)
        else:
            count = self.view_batch_size if self.training else self.eval_view_batch_size
            returned = self.network(images, rays, count)
        outputs = returned if isinstance(returned, Mapping) else {"out": returned}
        expected = (len(images), self.num_scores, *images.shape[-2:])
        self.checked_scores(outputs["out"], expected)
        return outputs

    def example(self, channels: int) -> Tensor:
        """Return one empty image ``(1, C, h, w)``."""
        return torch.zeros(1, channels, *self.representation.image_size)

    @property
    def inputs_per_sample(self) -> int:
        """Number of views of a panorama; 1 for a photo's crop and for an equirectangular image."""
        if not isinstance(self.representation, Representation):
            return 1
        return len(self.representation.sample(np.random.default_rng(0)).rays()) or 1

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return all images of a batch ``(n, C, h, w)`` and their labels ``(n, h, w)``."""
        return batch.images.flatten(0, 1), batch.labels.flatten(0, 1)

    def training_parts(self, batch: Any) -> list[Part]:
        """See `Task`; a network that takes rays gets all images, which it divides."""
        if self.sees_rays and batch.rays.numel():
            images, labels = self.training_pairs(batch)
            return [((images, batch.rays), labels)]
        return super().training_parts(batch)

    @abstractmethod
    def predict_sample(self, sample: EvaluationSample[Tensor]) -> tuple[Tensor, Tensor]:
        """Predict a panorama or the crops of a photo; add to the validation loss, except in a test.

        Returns:
            Prediction and truth for `metric`.
        """

    @torch.no_grad()
    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of panoramas or photos to `metric`; return the predictions."""
        predictions = []
        for fields in zip(*batch, strict=True):
            prediction, truth = self.predict_sample(EvaluationSample(*fields))
            self.metric.update(prediction, truth)
            predictions.append(prediction)
        return torch.stack(predictions)

    def view_sets(
        self, images: Tensor, rotation: NDArray[np.float64] | None, valid: NDArray[np.bool_] | None
    ) -> list[ViewSet]:
        """Return the sets of views of a panorama, with their images.

        Args:
            images: Images of all view sets of the representation, in this order.
            rotation: Rotation of the representation ``(3, 3)``.
            valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
        """
        rotated = self.representation
        if rotation is not None:
            rotated = rotated.with_rotation(rotation)
        sets = rotated.view_sets(valid)
        readers = (part.__getitem__ for part in torch.split(images, [len(views) for views in sets]))
        seen = upright_rays(sets, rotation, images.device) if self.sees_rays else [None] * len(sets)
        return list(zip(sets, readers, seen, strict=True))


def labels_of_views(target: Tensor, views: Any) -> Tensor:
    """Render the labels of a panorama ``(H, W)`` to views ``(n, h, w)``."""
    if target.is_cpu:
        return torch.from_numpy(views.render(target.numpy(), "nearest"))
    rendered: Tensor = views.render(target[None], "nearest")
    return rendered[:, 0]
