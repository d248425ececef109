"""Images of one sphere that see each other, at a stage of any network."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.chunks import KeptStatistics, joined, recomputed, same_draws, seeds
from models.sphere_tokens import add_tokens, lone_rays, to_tokens, token_directions
from models.stages import stage_channels
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["SphereContext"]

_HALF_TURN_DEG = 180.0


class _ReachedError(Exception):
    """Ends a run of the network at the stage.

    Attributes:
        tokens: Of the images of the run.
    """

    def __init__(self, tokens: Tensor) -> None:
        super().__init__("the stage was reached")
        self.tokens = tokens


@registered
class SphereContext(nn.Module):
    """A network for single images whose images of one sphere see each other.

    A tangent image sees only its field of view (paper, supplement, "Limitations"). Here features F
    at a stage of the network become F + enlarged(mixer(pooled(F))): a few tokens of every image are
    mixed with those of all images of its sphere, by the directions they look along. Mixers start at
    zero, so that before training this computes exactly what the network does, and can be added to
    a trained one. Any subset of the images of a sphere will do, or a single one, to which
    `SphereAttention` adds nothing.

    Args:
        network: Any module ``(B, C, h, w) -> scores``, a tensor or a mapping of tensors.
        stage: Name of one of its submodules, whose result is features ``(B, C', h', w')``:
            ``downs.3`` of a UNet, ``backbone.layer4`` of an FCN-ResNet.
        mixer: Makes the mixer from ``channels=C'``: a module that maps tokens ``(S, n, C', t, t)``
            and their directions ``(S, n, 3, t, t)``, n images of each of S spheres, to what is
            added to the tokens. `SphereAttention` or another.
        in_channels: Channels C of the images, to find C' out.
        channels: C', where it cannot be found out.
        tokens: Features are averaged to at most so many rows and columns of tokens.
        fov_deg: Angle that the width of an image spans if nothing else is said about its camera, as
            of a photo; to `SphereAttention`, which adds nothing there, it does not matter.

    Raises:
        SettingError: A setting that cannot work; of stages, it names those there are.
    """

    def __init__(
        self,
        network: nn.Module,
        stage: str,
        mixer: Callable[..., nn.Module],
        in_channels: int | None = None,
        channels: int | None = None,
        tokens: int = 4,
        fov_deg: float = 45.0,
    ) -> None:
        super().__init__()
        if not isinstance(tokens, int) or tokens < 1:
            raise SettingError("network.tokens", found=tokens, expected="a whole number from 1")
        if not 0 < fov_deg < _HALF_TURN_DEG:
            raise SettingError("network.fov_deg", found=fov_deg, expected="more than 0, below 180")
        if any(isinstance(module, SphereContext) for module in network.modules()):
            raise SettingError(
                "network.network", found="one with a SphereContext", expected="one without"
            )
        self.network = network
        self.mixer = mixer(channels=stage_channels(network, stage, in_channels, channels))
        self.stage, self.tokens, self.fov_deg = stage, tokens, fov_deg
        self._at_stage: Callable[[Tensor], Tensor] | None = None
        # First, so that an auxiliary head at the same stage sees what is added.
        network.get_submodule(stage).register_forward_hook(self._on_features, prepend=True)

    def forward(
        self,
        images: Float[Tensor, "images channels height width"],
        rays: Float[Tensor, "spheres images_of_sphere 3 3"] | None = None,
        images_per_chunk: int | None = None,
    ) -> Any:
        """What the network makes of images that see each other.

        Args:
            images: Sphere by sphere, as many of each.
            rays: For every image the matrix that maps image coordinates (x, y, 1) to directions on
                the sphere, of any length; x goes from −1 on the left edge of the image to 1 on the
                right one, y from −1 on the upper edge to 1 on the lower. Of a mirrored image the
                first column is negated. None: each image is alone on its sphere, with a camera of
                `fov_deg` held level.
            images_per_chunk: Bounds memory: no more images at once are in the network, and still
                all of a sphere see each other, and gradients are the same. Each chunk runs through
                the network once to the stage and once as a whole, and in training again for the
                gradient: about twice the time. Batch normalization sees one chunk at a time. None
                for all images at once.

        Raises:
            SettingError: `rays` and images do not fit each other, or the stage was not reached.
        """
        if rays is None:
            rays = lone_rays(images, self.fov_deg)
        elif rays.shape[0] * rays.shape[1] != images.shape[0]:
            raise SettingError(
                "rays",
                found=f"{rays.shape[0]} spheres of {rays.shape[1]} images",
                expected=f"spheres of {images.shape[0]} images together",
            )
        if images_per_chunk is None or images_per_chunk >= images.shape[0]:
            return self._run(images, partial(self._mixed, rays))
        return self._in_chunks(images, rays, images_per_chunk)

    def encode(
        self, images: Float[Tensor, "images channels height width"]
    ) -> Float[Tensor, "images features rows columns"]:
        """Tokens of images: the first of three steps for those who bound the memory themselves."""
        return self._encoded(images, None)

    def mix(
        self,
        rays: Float[Tensor, "spheres images_of_sphere 3 3"],
        tokens: Float[Tensor, "images features rows columns"],
    ) -> Float[Tensor, "images features rows columns"]:
        """What is added to the tokens of all images of the spheres: the second step."""
        directions = token_directions(rays, tokens.shape[-2], tokens.shape[-1])
        context: Tensor = self.mixer(tokens.reshape(*rays.shape[:2], *tokens.shape[1:]), directions)
        return context.flatten(0, 1)

    def decode(
        self,
        images: Float[Tensor, "images channels height width"],
        context: Float[Tensor, "images features rows columns"],
    ) -> Any:
        """What the network makes of images with their part of the second step: the third."""
        return self._decoded(images, context, None)

    def _run(self, images: Tensor, at_stage: Callable[[Tensor], Tensor]) -> Any:
        """The network's result, with features replaced at the stage."""
        self._at_stage = at_stage
        try:
            scores = self.network(images)
            reached = self._at_stage is None
        finally:
            self._at_stage = None
        if not reached:
            raise SettingError(
                "network.stage",
                found=f"{self.stage}, which the network does not run",
                expected="one that it does",
            )
        return scores

    def _on_features(self, _stage: nn.Module, _inputs: Any, features: Tensor) -> Tensor | None:
        """The hook; without effect when the network is run by anyone else."""
        at_stage, self._at_stage = self._at_stage, None
        return None if at_stage is None else at_stage(features)

    def _mixed(self, rays: Tensor, features: Tensor) -> Tensor:
        return add_tokens(features, self.mix(rays, to_tokens(features, self.tokens)))

    @torch.compiler.disable  # type: ignore[untyped-decorator]
    def _in_chunks(self, images: Tensor, rays: Tensor, size: int) -> Any:
        """Encode in chunks, mix the tokens of all, decode in chunks.

        Of what the network computes no more than one chunk is kept, and each run of a chunk draws
        the same random numbers. Running statistics take a chunk in when it is first decoded.
        """
        kept = KeptStatistics(self.network)
        chunks = torch.split(images, size)
        drawn = seeds(self.network, len(chunks))
        tokens = [
            recomputed(self._encoded, chunk, seed, first=kept, again=kept)
            for chunk, seed in zip(chunks, drawn, strict=True)
        ]
        contexts = torch.split(self.mix(rays, torch.cat(tokens)), size)
        decoded = [
            recomputed(self._decoded, *chunk, first=nullcontext(), again=kept)
            for chunk in zip(chunks, contexts, drawn, strict=True)
        ]
        return joined(decoded)

    def _encoded(self, images: Tensor, seed: int | None) -> Tensor:
        with same_draws(seed, images.device):
            try:
                self._run(images, self._stop)
            except _ReachedError as reached:
                return reached.tokens
        raise AssertionError  # `_run` has refused the stage

    def _stop(self, features: Tensor) -> Tensor:
        raise _ReachedError(to_tokens(features, self.tokens))

    def _decoded(self, images: Tensor, context: Tensor, seed: int | None) -> Any:
        with same_draws(seed, images.device):
            return self._run(images, lambda features: add_tokens(features, context))
