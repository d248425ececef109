"""Training and evaluation of networks for every pixel of panoramas and photos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from datamodules.core.dataset import Sample, valid_mask
from tangent_train.errors import SettingError, at_least
from tangent_train.heads import Head
from tangent_train.inference.engine import scored_views, sees_rays, upright_rays, view_scores
from tangent_train.rendering import EquirectRepresentation, IcosphereRepresentation
from tangent_train.rendering.representations.views import Representation
from tangent_train.tasks.base import Part, Task

ViewSet = tuple[Any, Any, Tensor | None]
"""Views, a function that returns some of their images, and viewing rays for networks that take
them."""


class PixelTask(Task):
    """Trains a network on views of panoramas, or on crops of photos, and scores whole images.

    The views of all images of a batch, on all processes, contribute to one gradient (paper,
    supplement, "Semantic segmentation"). Validation and test cover the whole sphere, or the whole
    photo; the outputs are put together and compared with the original labels.

    Args:
        network: Module ``(B, C, h, w) -> (B, K, h, w)``, or one that returns a dict with this
            output under ``"out"`` and optionally that of an auxiliary head under ``"aux"``. A
            network whose `forward` also takes ``rays`` and ``view_batch_size`` gets the viewing
            rays of its images and bounds its memory (`models.SphereContext`).
        representation: Representation of the images.
        head: The meaning of the output.
        *arguments: Optimizer and scheduler, see `Task`.
        auxiliary_weight: Weight of the loss of the auxiliary output.
        eval_view_batch_size: Number of images per forward pass in evaluation, which bounds memory.
        **settings: Further arguments of `Task`.
    """

    def __init__(
        self,
        network: nn.Module,
        representation: Any,
        head: Head,
        *arguments: Any,
        auxiliary_weight: float = 0.4,
        eval_view_batch_size: int = 32,
        **settings: Any,
    ) -> None:
        super().__init__(network, representation, head, *arguments, **settings)
        self.sees_rays = sees_rays(network)
        whole = EquirectRepresentation | IcosphereRepresentation
        if self.sees_rays and isinstance(representation, whole):
            raise SettingError(
                "representation",
                found="one view of the whole sphere",
                expected="tangent images or a cube map for a network with cross-image context",
                remedy="Use the network without context.",
            )
        head.num_outputs = getattr(network, "num_outputs", head.num_outputs)
        self.auxiliary_weight = auxiliary_weight
        self.eval_view_batch_size = at_least("task.eval_view_batch_size", eval_view_batch_size, 1)

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
        found = tuple(outputs["out"].shape)
        expected = (len(images), self.head.num_outputs, *images.shape[-2:])
        if found != expected:
            raise SettingError(
                "output of the network",
                found=found,
                expected=expected,
                remedy="Set network.num_classes to the number of classes, or to null.",
            )
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
        """Return all images of a batch ``(n, C, h, w)`` and their targets, see `Head.targets`."""
        truth = self.head.truth(batch.labels.flatten(0, 1))
        lengths = batch.ray_lengths.expand(*batch.labels.shape[:2], *batch.ray_lengths.shape[-2:])
        return batch.images.flatten(0, 1), self.head.targets(truth, lengths.flatten(0, 1))

    def training_parts(self, batch: Any) -> list[Part]:
        """See `Task`; a network that takes rays gets all images, which it divides."""
        if self.sees_rays and batch.rays.numel():
            images, targets = self.training_pairs(batch)
            return [((images, batch.rays), targets)]
        return super().training_parts(batch)

    def loss_sum(self, inputs: tuple[Tensor, ...], targets: Tensor) -> Tensor:
        """Return the loss, summed over pixels, including that of an auxiliary output."""
        outputs = self.outputs(*inputs)
        loss = self.head.loss_sum(outputs["out"], targets)
        if "aux" not in outputs:
            return loss
        return loss + self.auxiliary_weight * self.head.auxiliary_sum(outputs["aux"], targets)

    @torch.no_grad()
    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of panoramas or photos to `metric`; return the predictions."""
        predictions = []
        for fields in zip(*batch, strict=True):
            sample: Sample[Tensor] = Sample(*fields)
            truth = self.head.truth(sample.labels)
            if truth.ndim == 2:
                where = sample.rotation.cpu().numpy(), valid_mask(sample.valid)
                predicted = self.predict_panorama(sample.images, tuple(truth.shape), *where, truth)
                prediction = self.head.comparable(predicted, truth)
            else:
                predicted = self.predict_crops(sample, truth)
                prediction = self.head.comparable(predicted, truth, sample.ray_lengths)
            self.metric.update(prediction, truth)
            predictions.append(prediction)
        return torch.stack(predictions)

    def predict_crops(self, sample: Sample[Tensor], truth: Tensor) -> Tensor:
        """Predict the crops of a photo ``(n, h, w)``; see `predict_panorama`."""
        lengths = sample.ray_lengths
        lengths = lengths.expand(len(truth), *lengths.shape[-2:])
        predictions, step = [], self.eval_view_batch_size
        for part, outputs in view_scores(self, sample.images.__getitem__, len(truth), step):
            predictions.append(self.head.crop_pixels(outputs, lengths[part]))
            self._add_loss(outputs, truth[part], lengths[part])
        return torch.cat(predictions)

    def predict_panorama(
        self,
        images: Float[Tensor, "images channels height width"],
        shape: Any,
        rotation: NDArray[np.float64] | None = None,
        valid: NDArray[np.bool_] | None = None,
        truth: Tensor | None = None,
    ) -> Tensor:
        """Predict every pixel of a panorama, see `Head`.

        Args:
            images: Images of all view sets of the representation, in this order.
            shape: ``(H, W)`` of the panorama.
            rotation: Rotation of the representation ``(3, 3)``.
            valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
            truth: Result of `Head.truth`, to add to the validation loss, except in a test.
        """
        sets = self.view_sets(images, rotation, valid)
        how: dict[str, Any] = {"averaged": len(sets) > 1, "device": images.device}
        mosaic = self.head.mosaic(shape, self.representation.blend, valid=valid, **how)
        for views, outputs in scored_views(self, sets, self.eval_view_batch_size):
            mosaic.add(outputs, views)
            if truth is not None and not self.is_tested:
                lengths = torch.from_numpy(views.ray_lengths()).to(outputs.device)
                self._add_loss(outputs, labels_of_views(truth, views), lengths)
        return mosaic.pixels().to(images.device)

    def _add_loss(self, outputs: Tensor, truth: Tensor, lengths: Tensor) -> None:
        """Add the loss of views, without auxiliary outputs, to the validation loss."""
        if not self.is_tested:
            self.add_validation_loss(outputs, self.head.targets(truth, lengths))

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
