"""Tiny depth networks of transformers with random weights, and the pipeline of that library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.kinds import DepthKind
from tangent_train.photo_networks import PhotoNetwork
from tests.photo_networks.huggingface_networks import Made, transformers

_PATCHES = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2}
_HEAD = {
    "neck_hidden_sizes": [8, 8, 16, 16],
    "reassemble_factors": [4, 2, 1, 0.5],
    "fusion_hidden_size": 8,
}
_STAGES = ["stage1", "stage2", "stage3", "stage4"]


def _square(side: int) -> dict[str, int]:
    return {"height": side, "width": side}


def _dinov2(side: int, **settings: Any) -> Any:
    stages = {"out_features": _STAGES, "reshape_hidden_states": False}
    return transformers.Dinov2Config(
        image_size=side, **{**_PATCHES, "patch_size": 14} | stages | settings
    )


def depth_anything(**settings: Any) -> Made:
    config = transformers.DepthAnythingConfig(
        backbone_config=_dinov2(70),
        reassemble_hidden_size=16,
        head_hidden_size=8,
        **_HEAD,
        **settings,
    )
    processor = transformers.DPTImageProcessor(
        size=_square(70), keep_aspect_ratio=True, ensure_multiple_of=14
    )
    return transformers.DepthAnythingForDepthEstimation(config), processor


def metric_depth_anything() -> Made:
    return depth_anything(depth_estimation_type="metric", max_depth=20)


def dpt() -> Made:
    """A ViT, as in MiDaS 3."""
    config = transformers.DPTConfig(
        **_PATCHES, **_HEAD, intermediate_size=32, image_size=64, backbone_out_indices=[0, 1, 2, 3]
    )
    processor = transformers.DPTImageProcessor(size=_square(64))
    return transformers.DPTForDepthEstimation(config), processor


def dpt_dinov2() -> Made:
    """Its depth is larger than the image and is resized."""
    config = transformers.DPTConfig(backbone_config=_dinov2(70), add_projection=False, **_HEAD)
    processor = transformers.DPTImageProcessor(
        size=_square(70), ensure_multiple_of=14, do_pad=True, size_divisor=14
    )
    return transformers.DPTForDepthEstimation(config), processor


def zoedepth(heads: int = 1) -> Made:
    backbone = transformers.BeitConfig(
        **_PATCHES,
        intermediate_size=32,
        image_size=64,
        patch_size=16,
        use_relative_position_bias=True,
        reshape_hidden_states=False,
        out_features=_STAGES,
    )
    bins = [
        {"n_bins": 8, "min_depth": 0.001, "max_depth": most, "name": name}
        for name, most in (("nyu", 10.0), ("kitti", 80.0))
    ]
    config = transformers.ZoeDepthConfig(
        backbone_config=backbone,
        **_HEAD,
        num_relative_features=8,
        bottleneck_features=8,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=bins[:heads],
        patch_transformer_hidden_size=128,
        patch_transformer_intermediate_size=8,
        patch_transformer_num_attention_heads=2,
        num_patch_transformer_layers=4,
    )
    processor = transformers.ZoeDepthImageProcessor(size=_square(64), ensure_multiple_of=32)
    return transformers.ZoeDepthForDepthEstimation(config), processor


def zoedepth_of_two() -> Made:
    return zoedepth(2)


def glpn() -> Made:
    config = transformers.GLPNConfig(
        hidden_sizes=[8, 8, 16, 16],
        depths=[1] * 4,
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )
    return transformers.GLPNForDepthEstimation(config), transformers.GLPNImageProcessor()


def depth_pro() -> Made:
    patches = transformers.Dinov2Config(image_size=16, patch_size=4, **_PATCHES)
    config = transformers.DepthProConfig(
        patch_size=16,
        fusion_hidden_size=8,
        intermediate_hook_ids=[2, 1],
        intermediate_feature_dims=[8, 8],
        scaled_images_feature_dims=[8, 8, 8],
        image_model_config=patches,
        patch_model_config=patches,
        fov_model_config=patches,
        use_fov_model=True,
    )
    processor = transformers.DepthProImageProcessor(size=_square(64))
    return transformers.DepthProForDepthEstimation(config), processor


def tipsv2() -> Made:
    backbone = transformers.Tipsv2VisionConfig(
        **_PATCHES,
        intermediate_size=32,
        image_size=56,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        apply_layernorm=True,
        reshape_hidden_states=False,
    )
    config = transformers.Tipsv2DptConfig(backbone_config=backbone, num_depth_bins=8, **_HEAD)
    processor = transformers.Tipsv2DptImageProcessor(size=_square(56))
    return transformers.Tipsv2DptForDepthEstimation(config), processor


def photo(side: int) -> Any:
    """Blocks of noise, ``(side, side, 3)``."""
    blocks = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    return np.array(Image.fromarray(blocks).resize((side, side), Image.Resampling.BICUBIC))


FAMILIES: tuple[tuple[Any, int, DepthKind | None, DepthKind], ...] = (
    (depth_anything, 70, None, "relative_disparity"),
    (metric_depth_anything, 70, None, "metric_z"),
    (dpt, 64, "relative_disparity", "relative_disparity"),
    (dpt_dinov2, 70, "metric_z", "metric_z"),
    (zoedepth, 64, None, "metric_z"),
    (zoedepth_of_two, 64, None, "metric_z"),
    (glpn, 64, None, "metric_z"),
    (depth_pro, 64, None, "canonical_inverse"),
    (tipsv2, 56, None, "metric_z"),
)
"""Networks, the side of their images, the setting ``depth``, and the kind of their output."""


@torch.no_grad()
def own_depth(folder: Path, image: Any, fov_deg: float | None = None) -> Tensor:
    """``(h, w)`` depth of the library's own pipeline.

    Args:
        folder: Folder of the saved network.
        image: ``(h, w, 3)`` photo.
        fov_deg: Field of view that replaces the estimate of Depth Pro.
    """
    pipeline = transformers.pipeline("depth-estimation", model=str(folder), device="cpu")
    if fov_deg is None:
        return torch.as_tensor(pipeline(Image.fromarray(image))["predicted_depth"])
    outputs = pipeline.model(**pipeline.image_processor(image, return_tensors="pt"))
    outputs.field_of_view = torch.tensor([fov_deg])
    (result,) = pipeline.image_processor.post_process_depth_estimation(outputs, [image.shape[:2]])
    return torch.as_tensor(result["predicted_depth"])


@torch.no_grad()
def depth_of(network: PhotoNetwork | LoadedNetwork, image: Any) -> Tensor:
    """``(h, w)`` depth of an imported network, before or after it is saved."""
    rgb = torch.from_numpy(image.copy()).permute(2, 0, 1) / 255
    mean, std = (
        torch.tensor(values)[:, None, None]
        for values in (network.normalization.mean, network.normalization.std)
    )
    depth: Tensor = network.module.eval()(((rgb - mean) / std)[None])[0, 0]
    return depth
