"""Depth Anything 3: depth and cameras of many views in one call."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from jaxtyping import Float
from omegaconf import OmegaConf
from torch import Tensor, nn

from models.unet import check_size
from tangent_train.errors import SettingError, check_choice

_PRESETS = ("da3-small", "da3-base", "da3-large", "da3-giant")
"""Configurations of the package for many views."""


class DepthAnything3(nn.Module):
    """Depth Anything 3 (Lin et al. 2025) with random weights, of the package depth-anything-3.

    The metadata of the package excludes NumPy 2, so it is not an extra. Its networks work with it.
    Names of tensors are those of the published weights.

    Args:
        preset: Name of a configuration of the package.

    Raises:
        SettingError: The package is missing, or has no such preset for many views.
    """

    size_multiple = 14

    def __init__(self, preset: str = "da3-large") -> None:
        super().__init__()
        check_choice("network.preset", preset, _PRESETS)
        try:
            config = import_module("depth_anything_3.cfg")
            OmegaConf.clear_resolver("eval")  # it would run code in any config
            import_module("depth_anything_3.utils.logger").logger.level = 0  # else it prints
            files = import_module("depth_anything_3.registry").MODEL_REGISTRY
            self.model: Any = config.create_object(config.load_config(files[preset]))
        except ImportError as error:
            raise SettingError(
                "network",
                found=f"a missing package ({error})",
                expected="the package depth-anything-3",
                remedy="Run: pip install --no-deps depth-anything-3 addict einops.",
            ) from error

    def forward(
        self,
        images: Float[Tensor, "views 3 height width"],
        world_from_camera: Float[Tensor, "views 3 3"],
        camera_matrix: Float[Tensor, "views 3 3"],
    ) -> dict[str, Tensor]:
        """Return z-depth up to a scale, its confidence, and the rotations of the camera decoder.

        Cameras are given as in the package: relative to the first one, with pixel corners at
        whole numbers.

        Raises:
            SettingError: The images cannot be divided into the network's patches.
        """
        check_size(images.shape[-2:], self.model, self.size_multiple, None)
        extrinsics = torch.eye(4).to(images).repeat(len(images), 1, 1)
        extrinsics[:, :3, :3] = world_from_camera.mT @ world_from_camera[0]
        corner = camera_matrix.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        found = self.model(images[None], extrinsics[None], (camera_matrix + corner)[None])
        own = found["extrinsics"][0, :, :3, :3].mT
        depth, confidence = found["depth"][0], found["depth_conf"][0]
        return {"out": depth, "confidence": confidence, "world_from_camera": own}
