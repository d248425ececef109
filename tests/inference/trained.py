"""Small trained networks, and their checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from datamodules.core.inputs import RGB_NORMALIZATION, RGBD_NORMALIZATION
from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from tangent_train.checkpoints.loaded import METADATA_KEY, LoadedNetwork
from tangent_train.config.build import build_from_config
from tangent_train.geometry import equirect_directions
from tangent_train.kinds import DepthKind

CLASS_NAMES = ("unknown", "dark", "green", "bright")

_RENDERING = "tangent_train.rendering."
TANGENT = {"_target_": _RENDERING + "TangentRepresentation", "base_level": 0, "level": 4}
ERP = {"_target_": _RENDERING + "EquirectRepresentation", "level": 4}
ICOSPHERE = {"_target_": _RENDERING + "IcosphereRepresentation", "level": 4}
CUBE = {"_target_": _RENDERING + "CubemapRepresentation", "level": 4}
PERSPECTIVE = {"_target_": _RENDERING + "PerspectiveRepresentation", "level": 6, "dim": 24}


def sphere(height: int) -> NDArray[np.uint8]:
    """Colors that are smooth on the sphere."""
    x, y, z = np.moveaxis(equirect_directions((height, 2 * height)), -1, 0)
    return np.stack([128 + 120 * x, 128 + 120 * y * z, 128 + 120 * z], axis=-1).astype(np.uint8)


def color_network(channels: int = 3, kernel: int = 3) -> nn.Conv2d:
    """A network whose scores distinguish dark, green and bright."""
    generator = torch.Generator().manual_seed(0)
    network = nn.Conv2d(channels, 3, kernel, padding=kernel // 2, padding_mode="replicate")
    with torch.no_grad():
        noise = torch.randn(4, *network.weight.shape[1:], generator=generator)[1:]
        network.weight.copy_(0.2 * noise)
        middle = network.weight[:, :, kernel // 2, kernel // 2]
        middle[0, :3] -= 1
        middle[1, :3] += torch.tensor([-1.0, 2, -1])
        middle[2, :3] += 1
        network.load_state_dict({"bias": torch.zeros(3)}, strict=False)
    return network.eval()


def trained_network(
    representation: dict[str, Any], channels: int = 3, **changes: Any
) -> LoadedNetwork:
    """Return a network trained with a representation."""
    settings = {
        "module": color_network(channels),
        "class_names": CLASS_NAMES,
        "inputs": ("rgb", "depth")[: channels - 2],
        "normalization": RGB_NORMALIZATION if channels == 3 else RGBD_NORMALIZATION,
        "level": representation["level"],
        "representation": representation,
        "image_size": build_from_config(representation, "representation").image_size,
    }
    settings["predicts"] = PIXEL_CLASSES if changes.get("depth_kind") is None else DISTANCE
    return LoadedNetwork(**(settings | changes))


def write_checkpoint(
    path: Path, representation: dict[str, Any] = TANGENT, channels: int = 3
) -> Path:
    """Write a checkpoint of such a network, as `tangent-train` does."""
    settings = {"_target_": "torch.nn.Conv2d", "in_channels": channels, "out_channels": 3}
    settings |= {"kernel_size": 3, "padding": 1, "padding_mode": "replicate"}
    loaded = trained_network(representation, channels, settings=settings)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_network(path, loaded)
    return path


def save_network(path: Path, loaded: LoadedNetwork) -> None:
    """Write a checkpoint without entries of Lightning."""
    tensors = {f"network.{name}": tensor for name, tensor in loaded.module.state_dict().items()}
    torch.save({METADATA_KEY: loaded.plain(), "state_dict": tensors}, path)


def write_depth_checkpoint(
    path: Path,
    depth_kind: DepthKind = "log_distance",
    tensors: dict[str, torch.Tensor] | None = None,
) -> Path:
    """Write a checkpoint of a depth network: a 3×3 convolution to one channel."""
    settings = {"_target_": "torch.nn.Conv2d", "in_channels": 3, "out_channels": 1}
    settings |= {"kernel_size": 3, "padding": 1, "padding_mode": "replicate"}
    module = build_from_config(settings, "network")
    usual = {name: tensor[:1] for name, tensor in color_network().state_dict().items()}
    module.load_state_dict(usual if tensors is None else tensors)
    of_depth: dict[str, Any] = {"class_names": (), "depth_kind": depth_kind}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_network(path, trained_network(TANGENT, module=module, settings=settings, **of_depth))
    return path
