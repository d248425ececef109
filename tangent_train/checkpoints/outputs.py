"""Convert the output of networks to what heads take: logits of classes, or depth."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.distortion_aware import make_distortion_aware
from models.segments import Segments
from tangent_train.checkpoints.cameras import cameras_of_rays, rotation_error_deg
from tangent_train.errors import SettingError
from tangent_train.kinds import ScoreKind

_MAP = 3
"""Number of dimensions of labels or depth without an axis of channels."""

_MAPS = "out", "confidence"
"""Outputs of a depth network with a value at every pixel."""

_POINTS = 3
"""Number of channels of points."""

_CERTAIN = 20.0
"""Score of a pixel's class if the network returns labels."""

Groups = Sequence[Sequence[int]]
"""Indices of the scores of each class, whose probabilities are added up."""


class OutputNetwork(nn.Module):
    """A network whose output is converted, for images of any size.

    Args:
        network: Network that maps images ``(B, C, h, w)`` to scores ``(B, K, h, w)``, to label maps
            or depth, with or without an axis of channels, or to a dict with one of these under
            ``"out"`` (as in torchvision). If its `forward` also takes ``camera_matrix``
            ``(B, 3, 3)``, it gets the matrix K of each view, see `cameras_of_rays`. If it takes
            ``world_from_camera`` and ``camera_matrix`` ``(V, 3, 3)``, the images are all V views of
            a panorama. A dict of a depth network may also contain ``"confidence"``
            ``(B, h, w)`` and its own ``"world_from_camera"``.
        num_outputs: Number of channels of its output: K classes, or `depth_channels`.
        groups: Indices of the network's scores for each class, including index K of kinds that
            have it. Scores in no group, and classes without scores, never win. None if each score
            is a class.
        tile: Rows and columns of the only image size that the network takes; None if it takes other
            sizes. Larger images are divided for classes. For depth, images are resized: the parts
            of an image would have different scales.
        kind: Kind of the scores; None for depth.
        gain: Number by which depth is multiplied: for z-depth in meters of one camera, the width of
            its image at distance 1 makes it `canonical_z`.

    Attributes:
        num_outputs: Number of channels of the converted output, with `groups` their number.
        tile: See above.
        takes_cameras: True if the network takes views of a panorama with their cameras.
        takes_all_views: True if it takes those of a panorama in one call.
    """

    def __init__(
        self,
        network: nn.Module,
        num_outputs: int,
        groups: Groups | None = None,
        tile: tuple[int, int] | None = None,
        kind: ScoreKind | None = "logits",
        gain: float = 1.0,
    ) -> None:
        super().__init__()
        self.network = network
        self.num_outputs = num_outputs if groups is None else len(groups)
        self.tile = tile
        self._groups, self._kind, self._gain = groups, kind, gain
        named = signature(network.forward).parameters
        self.takes_cameras = "camera_matrix" in named
        self.takes_all_views = "world_from_camera" in named

    def forward(self, images: Tensor, *arguments: Any, **settings: Any) -> Any:
        """Return the converted output ``(B, num_outputs, h, w)``.

        A depth network that returns a confidence or rotations yields a dict: the output under
        ``"out"``, ``"confidence"`` ``(B, 1, h, w)`` and ``"rotation_error_deg"``. So does a network
        of classes that returns objects: ``"segments"``, a list of `Segments`, whose classes become
        those of the output. Tiles have no objects.

        Args:
            images: Normalized images ``(B, C, h, w)``.
            *arguments: Further arguments of the network; first ``rays`` ``(1, V, 3, 3)`` for
                cameras.
            **settings: Further arguments of the network, by name.

        Raises:
            SettingError: The network takes cameras, and the images are not views of a panorama.
        """
        size = (images.shape[-2], images.shape[-1])
        if self._kind is None:
            return self._depth(images, size, *arguments, **settings)
        convert = partial(self._scores, self._kind)
        if self.tile in (None, size):
            return convert(images, *arguments, **settings)
        return _mean_of_tiles(convert, images, self.tile)

    def _depth(self, images: Tensor, size: Any, *arguments: Any, **settings: Any) -> Any:
        tile = self.tile or size
        if self.takes_cameras:
            if not arguments:
                expected = "a panorama in tangent images, horizontal views or a cube map"
                raise SettingError("views", found="views without cameras", expected=expected)
            batch = settings.get("view_batch_size")
            arguments, settings = cameras_of_rays(arguments[0][0], tile), {}
        images = images if tile == size else _resized(images, tile)
        if self.takes_cameras and not self.takes_all_views:
            given = (torch.split(each, batch or len(images)) for each in (images, arguments[1]))
            parts = [named_outputs(self.network(*part)) for part in zip(*given, strict=True)]
            returned = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        else:
            returned = dict(named_outputs(self.network(images, *arguments, **settings)))
        outputs = {n: _with_channels(returned[n]) for n in _MAPS if n in returned}
        if self._gain != 1:  # an operation less
            outputs["out"] = outputs["out"] * self._gain
        if tile != size:
            outputs = {name: _resized(values, size) for name, values in outputs.items()}
        if self.takes_cameras and "world_from_camera" in returned:
            error = rotation_error_deg(returned["world_from_camera"], arguments[0])
            outputs["rotation_error_deg"] = error
        return outputs if len(outputs) > 1 else outputs["out"]

    def _scores(self, kind: ScoreKind, images: Tensor, *arguments: Any, **settings: Any) -> Any:
        returned = named_outputs(self.network(images, *arguments, **settings))
        outputs, groups = returned["out"], self._groups
        last = self.num_outputs - 1 if groups is None else max(k for group in groups for k in group)
        scores = as_logits(outputs, kind, last)
        if groups is not None:
            scores = torch.cat([_sum(scores, group) for group in groups], dim=1)
        if "segments" not in returned:
            return scores
        segments = [_regrouped(each, groups) for each in returned["segments"]]
        return {"out": scores, "segments": segments}


def _regrouped(segments: Segments, groups: Groups | None) -> Segments:
    """Return objects with the number of the group of their class; −1 for none."""
    if groups is None:
        return segments
    group_of = {k: number for number, group in enumerate(groups) for k in group}
    found = [group_of.get(k, -1) for k in segments.classes.tolist()]
    return segments._replace(classes=torch.tensor(found).to(segments.classes))


def network_for_views(network: nn.Module, distortion_aware: bool | None) -> nn.Module:
    """Return a network as it is applied to views: distortion-aware if they are.

    Args:
        network: The network, see `make_distortion_aware`.
        distortion_aware: Setting of the representation; None if it has no such setting.

    Raises:
        SettingError: The convolutions cannot be sampled on the sphere.
    """
    return make_distortion_aware(network) if distortion_aware else network


def named_outputs(returned: Any) -> Mapping[str, Tensor]:
    """Return the outputs of a network by name, the main one under ``"out"``."""
    return returned if isinstance(returned, Mapping) else {"out": returned}


def plain_output(returned: Any) -> Tensor:
    """Return the main output of a network, which returns a dict in torchvision."""
    return named_outputs(returned)["out"]


def example_inputs(network: nn.Module, images: Tensor) -> tuple[Tensor, ...]:
    """Return images ``(B, C, h, w)`` with the rays of views straight ahead, if cameras are taken.

    Args:
        network: `LoadedNetwork.network`, or an `OutputNetwork`.
        images: Images to test the network with.
    """
    if not getattr(network, "takes_cameras", False):
        return (images,)
    return images, torch.eye(3).expand(1, len(images), 3, 3)


def _with_channels(values: Tensor) -> Tensor:
    """Return maps ``(B, h, w)`` or points ``(B, h, w, 3)`` with their channels first."""
    if values.ndim == _MAP:
        return values[:, None]
    is_last = values.shape[-1] == _POINTS and values.shape[1] not in (1, _POINTS)
    return values.movedim(-1, 1) if is_last else values


def as_logits(scores: Tensor, kind: ScoreKind, num_labels: int) -> Tensor:
    """Convert scores so that their softmax is the probability of each class.

    Args:
        scores: Scores ``(B, K, h, w)`` or label maps.
        kind: Kind of the scores.
        num_labels: Number K of labels in label maps.

    Returns:
        Scores ``(B, K, h, w)``; ``(B, K + 1, h, w)`` for label maps and for a single score, see
        `ScoreKind`.
    """
    if kind == "labels":
        values = scores if scores.ndim == _MAP else scores[:, 0]
        known = (values >= 0) & (values < num_labels)  # False for NaN
        labels = torch.where(known, values.long(), num_labels)
        return functional.one_hot(labels, num_labels + 1).movedim(-1, 1) * _CERTAIN
    if scores.shape[1] == 1 or kind == "probabilities":  # a limit would make infinity a probability
        scores = scores.where(scores.isfinite(), torch.nan)
    if scores.shape[1] == 1:
        limit = torch.finfo(scores.dtype).eps
        logits = scores.logit(limit) if kind == "probabilities" else scores
        return torch.cat([logits, torch.zeros_like(logits)], dim=1)
    if kind == "probabilities":
        return scores.clamp_min(torch.finfo(scores.dtype).tiny).log()
    return scores


def _sum(scores: Tensor, group: Sequence[int]) -> Tensor:
    """Return the logarithm of a sum of probabilities, up to a constant of the pixel."""
    if not group:
        # Less than all others at every pixel, and so in means over pixels. Not minus infinity,
        # which becomes NaN when it is weighted by 0.
        return scores.amin(1, keepdim=True) - _CERTAIN
    chosen = scores[:, list(group)]
    return chosen if len(group) == 1 else chosen.logsumexp(1, keepdim=True)


def _resized(images: Tensor, size: Any) -> Tensor:
    return functional.interpolate(images, size, mode="bilinear", antialias=True)


def _mean_of_tiles(
    network: Callable[[Tensor], Any], images: Tensor, tile: tuple[int, int]
) -> Tensor:
    """Return the mean scores of evenly spaced tiles that cover larger images."""
    tops, lefts = (
        torch.linspace(0, side - part, -(-side // part)).round().int().tolist()
        for side, part in zip(images.shape[-2:], tile, strict=True)
    )
    total, count = torch.zeros(()), images.new_zeros((len(images), 1, *images.shape[-2:]))
    for top, left in itertools.product(tops, lefts):
        area = (..., slice(top, top + tile[0]), slice(left, left + tile[1]))
        scores = plain_output(network(images[area]))
        if not total.ndim:
            total = scores.new_zeros(*scores.shape[:2], *images.shape[-2:])
        total[area] += scores
        count[area] += 1
    return total / count
