"""Additions at a stage of any network: cross-image context, and deep supervision."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch._compile import _disable_dynamo
from torch.nn import functional
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

_SIDE = 256
"""Side of the empty image that is used to find the number of channels."""


def stage_channels(network: nn.Module, stage: str, in_channels: int) -> int:
    """Return the number of channels C' of the features ``(B, C', h', w')`` of a submodule.

    A copy of the network is run on an empty image.

    Args:
        network: Network of images ``(B, C, h, w)``.
        stage: Name of a submodule that is run once per image.
        in_channels: Channels C of the images.
    """
    found: list[Tensor] = []
    probe = copy.deepcopy(network).eval()
    probe.get_submodule(stage).register_forward_hook(lambda *given: found.append(given[2]))
    with torch.no_grad():
        probe(torch.zeros(1, in_channels, _SIDE, _SIDE))
    (features,) = found
    return features.shape[1]


class AuxiliaryHead(nn.Module):
    """Adds scores at an encoder stage to those of the network, in training only.

    A 1×1 convolution on the features of the stage. It trains deep layers, which a
    network with skip connections otherwise starts to use late. Evaluation and export do not change.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping with one under
            ``"out"``.
        stage: Name of a submodule, whose result is features ``(B, C', h', w')``.
        in_channels: Channels C of the images.
        num_classes: Classes K.
    """

    def __init__(self, network: nn.Module, stage: str, in_channels: int, num_classes: int) -> None:
        super().__init__()
        self.network = network
        self.auxiliary_head = nn.Conv2d(stage_channels(network, stage, in_channels), num_classes, 1)
        self._features: Tensor | None = None
        network.get_submodule(stage).register_forward_hook(self._keep)

    def forward(self, images: Tensor) -> Any:
        """Return the network's result; in training ``{"out": scores, "aux": (B, K, h', w')}``.

        Args:
            images: ``(B, C, h, w)``.
        """
        scores = self.network(images)
        features, self._features = self._features, None
        if features is None:
            return scores
        named = scores if isinstance(scores, Mapping) else {"out": scores}
        return {**named, "aux": self.auxiliary_head(features)}

    def _keep(self, _stage: nn.Module, _inputs: Any, features: Tensor) -> None:
        self._features = features if self.training else None


class _ReachedError(Exception):
    """Ends a forward pass of the network at the stage; carries the features."""


class SphereContext(nn.Module):
    """Lets the images of a sphere exchange features inside a network of single images.

    A tangent image sees only its field of view (paper, supplement, "Limitations"). Here the
    features F at a stage become F + upsample(mixer(pool(F))): a few tokens per image are mixed with
    those of all images of the sphere, by viewing direction. Mixers start at zero, so that a trained
    network returns the same at first. Any subset of the images of a sphere can be used.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping of tensors.
        stage: Name of a submodule, whose result is features ``(B, C', h', w')``: ``downs.3`` of a
            UNet, ``backbone.layer4`` of an FCN-ResNet.
        mixer: Function that creates the mixer from ``channels=C'``, e.g. `SphereAttention`. A mixer
            is a module that maps tokens ``(S, n, C', t, t)`` and directions ``(S, n, 3, t, t)`` of
            n images on each of S spheres to the residual of the tokens.
        in_channels: Channels C of the images.
        tokens: Maximum rows and columns of tokens per image.
    """

    def __init__(
        self,
        network: nn.Module,
        stage: str,
        mixer: Callable[..., nn.Module],
        in_channels: int,
        tokens: int = 4,
    ) -> None:
        super().__init__()
        self.network = network
        self.mixer = mixer(channels=stage_channels(network, stage, in_channels))
        self.tokens = tokens
        self._at_stage: Callable[[Tensor], Tensor] | None = None
        # First, so that an auxiliary head at the same stage gets features with context.
        network.get_submodule(stage).register_forward_hook(self._on_features, prepend=True)

    def forward(
        self,
        images: Float[Tensor, "images channels height width"],
        rays: Float[Tensor, "spheres images_of_sphere 3 3"] | None = None,
        view_batch_size: int | None = None,
    ) -> Any:
        """Return the network's result for images with context.

        Args:
            images: Images sphere by sphere, equally many of each.
            rays: Matrix of each image that maps image coordinates (x, y, 1) to directions on the
                sphere, of any length; x goes from −1 at the left edge to 1 at the right edge, y
                from −1 at the top to 1 at the bottom. The first column of a mirrored image is
                negated. None for images without context, e.g. photos.
            view_batch_size: Maximum number of images in the network at once, to limit memory; the
                context and the gradients are the same. Each chunk runs up to the stage, then as a
                whole, and both again in the backward pass, which takes about twice the time. Batch
                normalization sees one chunk at a time. None for all images at once.
        """
        if rays is None:
            return self.network(images)
        if view_batch_size is None or view_batch_size >= images.shape[0]:
            return self._run(images, lambda x: _add(x, self.mix(rays, self._pooled(x))))
        return self._in_chunks(images, rays, view_batch_size)

    def encode(
        self, images: Float[Tensor, "images channels height width"]
    ) -> Float[Tensor, "images features rows columns"]:
        """Return the tokens of images: step 1 of 3 of the variant with limited memory."""
        try:
            self._run(images, _stop)
        except _ReachedError as reached:
            tokens = self._pooled(reached.args[0])
        return tokens

    def mix(
        self,
        rays: Float[Tensor, "spheres images_of_sphere 3 3"],
        tokens: Float[Tensor, "images features rows columns"],
    ) -> Float[Tensor, "images features rows columns"]:
        """Return the residual of the tokens of all images of the spheres: step 2."""
        directions = token_directions(rays, tokens.shape[-2], tokens.shape[-1])
        context: Tensor = self.mixer(tokens.reshape(*rays.shape[:2], *tokens.shape[1:]), directions)
        return context.flatten(0, 1)

    def decode(
        self,
        images: Float[Tensor, "images channels height width"],
        context: Float[Tensor, "images features rows columns"],
    ) -> Any:
        """Return the network's result for images with their residual: step 3."""
        return self._run(images, lambda features: _add(features, context))

    def _run(self, images: Tensor, at_stage: Callable[[Tensor], Tensor]) -> Any:
        self._at_stage = at_stage
        try:
            return self.network(images)
        finally:
            self._at_stage = None

    def _on_features(self, _stage: nn.Module, _inputs: Any, features: Tensor) -> Tensor | None:
        return None if self._at_stage is None else self._at_stage(features)

    def _pooled(self, features: Tensor) -> Tensor:
        rows, columns = (min(side, self.tokens) for side in features.shape[-2:])
        return functional.adaptive_avg_pool2d(features, (rows, columns))

    @_disable_dynamo  # torch.compiler.disable would import the compiler now
    def _in_chunks(self, images: Tensor, rays: Tensor, size: int) -> Any:
        """Encode in chunks, mix the tokens of all, decode in chunks."""
        chunks = torch.tensor_split(images, -(-len(images) // size))  # even ones
        # Evaluation uses no random numbers.
        first = int(torch.randint(2**62, ())) if self.training else 0
        seeds = range(first, first + len(chunks))
        tokens = [
            self._recomputed(self.encode, chunk, seed=seed, counted=False)
            for chunk, seed in zip(chunks, seeds, strict=True)
        ]
        contexts = torch.tensor_split(self.mix(rays, torch.cat(tokens)), len(chunks))
        parts = [
            self._recomputed(self.decode, chunk, context, seed=seed, counted=True)
            for chunk, context, seed in zip(chunks, contexts, seeds, strict=True)
        ]
        if isinstance(parts[0], Tensor):
            return torch.cat(parts)
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def _recomputed(
        self, step: Callable[..., Any], *arguments: Tensor, seed: int, counted: bool
    ) -> Any:
        """Run a step without keeping activations; the backward pass runs it again.

        All runs of a chunk draw the same random numbers, and only one of them (the first, if
        `counted`) updates the running statistics of batch normalization.
        """
        first = iter([counted])

        def run(*inputs: Tensor) -> Any:
            frozen = () if next(first, False) else self.network.modules()
            device = inputs[0].device
            forked = torch.random.fork_rng([device] if device.type == "cuda" else [])
            with forked, _frozen_statistics(frozen):
                torch.manual_seed(seed)
                return step(*inputs)

        return checkpoint(run, *arguments, use_reentrant=False, preserve_rng_state=False)


def token_directions(
    rays: Float[Tensor, "spheres images 3 3"], rows: int, columns: int
) -> Float[Tensor, "spheres images 3 rows columns"]:
    """Return unit viewing directions of the token centers.

    Args:
        rays: Matrices from image coordinates to directions, see `SphereContext.forward`.
        rows: Rows of tokens.
        columns: Columns of tokens.
    """
    y, x = (
        (2 * torch.arange(count, dtype=rays.dtype, device=rays.device) + 1) / count - 1
        for count in (rows, columns)
    )
    along_x, along_y, along_z = rays[..., None, None].unbind(3)
    # Not as a matrix product, which autocast would compute in half precision.
    return functional.normalize(along_x * x + along_y * y[:, None] + along_z, dim=2)


def _add(features: Tensor, tokens: Tensor) -> Tensor:
    """Add upsampled tokens, in the dtype of the features."""
    upsampled = functional.interpolate(tokens, features.shape[-2:], mode="bilinear")
    return features + upsampled.to(features.dtype)


def _stop(features: Tensor) -> Tensor:
    raise _ReachedError(features)


@contextmanager
def _frozen_statistics(modules: Any) -> Iterator[None]:
    """Return a context that normalizes by batch statistics and keeps the running statistics."""
    norms = [m for m in modules if isinstance(m, _BatchNorm) and m.training]
    before = [(norm.momentum, norm.num_batches_tracked) for norm in norms]
    for norm in norms:
        # The buffers stay in place: a gradient needs the same ones in all passes.
        norm.momentum, norm.num_batches_tracked = 0.0, None
    try:
        yield
    finally:
        for norm, (momentum, batches) in zip(norms, before, strict=True):
            norm.momentum, norm.num_batches_tracked = momentum, batches
