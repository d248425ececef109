"""Tiny networks of transformers with random weights, and pipelines of that library."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.photo_networks import huggingface, import_network

transformers: Any = import_module("transformers")  # its types leave no room for `**settings`

NAMES = ("wall", "floor", "sky", "tree", "road", "car")
_SIDE = 64
_SIZE = {"height": _SIDE, "width": _SIDE}
_LABELS = {"id2label": dict(enumerate(NAMES)), "label2id": {n: k for k, n in enumerate(NAMES)}}
_STAGES = ["stage1", "stage2", "stage3", "stage4"]
_MASKS = {
    "encoder_feedforward_dim": 16,
    "encoder_layers": 1,
    "decoder_layers": 2,
    "num_attention_heads": 2,
    "num_queries": 7,
    "hidden_dim": 32,
    "dim_feedforward": 16,
}

Made = tuple[Any, Any]
"""A network and its image processor."""


def segformer(names: Sequence[str] = NAMES) -> Made:
    labels = {"id2label": dict(enumerate(names)), "label2id": {n: k for k, n in enumerate(names)}}
    stages = {"hidden_sizes": [8, 8, 16, 16], "num_attention_heads": [1, 1, 2, 2]}
    config = transformers.SegformerConfig(
        depths=[1] * 4, decoder_hidden_size=16, **stages, **labels
    )
    processor = transformers.SegformerImageProcessor(size=_SIZE)
    return transformers.SegformerForSemanticSegmentation(config), processor


def upernet() -> Made:
    """A UPerNet of ConvNeXt with all its parts, as published by OpenMMLab."""
    stages = {"hidden_sizes": [8, 8, 16, 16], "depths": [1] * 4, "out_features": _STAGES}
    config = transformers.UperNetConfig(
        backbone_config=transformers.ConvNextConfig(**stages),
        hidden_size=16,
        auxiliary_in_channels=16,
        auxiliary_channels=8,
        **_LABELS,
    )
    processor = transformers.SegformerImageProcessor(size=_SIZE, do_reduce_labels=True)
    return transformers.UperNetForSemanticSegmentation(config), processor


def mobilevit() -> Made:
    config = transformers.MobileViTConfig(
        hidden_sizes=[16, 16, 16],
        num_attention_heads=2,
        neck_hidden_sizes=[8] * 7,
        aspp_out_channels=16,
        **_LABELS,
    )
    processor = transformers.MobileViTImageProcessor(size={"shortest_edge": 72}, crop_size=_SIZE)
    return transformers.MobileViTForSemanticSegmentation(config), processor


def _swin() -> Any:
    return transformers.SwinConfig(
        embed_dim=8, depths=[1] * 4, num_heads=[1, 1, 2, 2], window_size=4, out_features=_STAGES
    )


def mask2former() -> Made:
    sizes = {"feature_size": 32, "mask_feature_size": 32}
    config = transformers.Mask2FormerConfig(backbone_config=_swin(), **sizes, **_MASKS, **_LABELS)
    processor = transformers.Mask2FormerImageProcessor(size=_SIZE)
    return transformers.Mask2FormerForUniversalSegmentation(config), processor


def maskformer() -> Made:
    decoder = {"encoder_layers": 1, "decoder_layers": 2, "num_queries": 7, "d_model": 32}
    decoder |= {"encoder_attention_heads": 2, "decoder_attention_heads": 2}
    decoder |= {"encoder_ffn_dim": 16, "decoder_ffn_dim": 16}
    config = transformers.MaskFormerConfig(
        fpn_feature_size=32,
        mask_feature_size=32,
        backbone_config=_swin(),
        decoder_config=transformers.DetrConfig(**decoder),
        **_LABELS,
    )
    processor = transformers.MaskFormerImageProcessor(size=_SIZE)
    return transformers.MaskFormerForInstanceSegmentation(config), processor


def oneformer(**processor_settings: Any) -> Made:
    sizes = {"conv_dim": 32, "mask_dim": 32, "task_seq_len": 24}
    config = transformers.OneFormerConfig(backbone_config=_swin(), **sizes, **_MASKS, **_LABELS)
    processor = transformers.OneFormerImageProcessor(size=_SIZE, **processor_settings)
    return transformers.OneFormerForUniversalSegmentation(config), processor


def eomt() -> Made:
    config = transformers.EomtConfig(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=_SIDE,
        num_queries=7,
        num_blocks=1,
        num_upscale_blocks=1,
        **_LABELS,
    )
    processor = transformers.EomtImageProcessor(size={"shortest_edge": 64, "longest_edge": 64})
    return transformers.EomtForUniversalSegmentation(config), processor


def saved(
    make: Callable[[], Made], folder: Path, noise: float = 0.1, **processor_settings: Any
) -> Made:
    """A network whose scores differ between pixels, saved with its processor."""
    torch.manual_seed(0)
    network, processor = make()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(noise * torch.randn_like(parameter))
    for name, value in processor_settings.items():
        setattr(processor, name, value)
    network.save_pretrained(folder)
    processor.save_pretrained(folder)
    return network.eval(), processor


def photo() -> Any:
    """Rows of noise, ``(64, 64, 3)``."""
    return np.random.default_rng(1).integers(0, 256, (_SIDE, _SIDE, 3), dtype=np.uint8)


@torch.no_grad()
def own_scores(network: Any, processor: Any, **arguments: Any) -> Tensor:
    """``(K, h, w)`` of the library's own pipeline of the photo, without changing its size."""
    pixels = processor(photo(), return_tensors="pt", do_resize=False)["pixel_values"]
    assert pixels.shape == (1, 3, _SIDE, _SIDE)
    returned = network(pixel_values=pixels, **arguments)
    if "patch_offsets" in returned:
        returned["patch_offsets"] = None
    (result,) = processor.post_process_semantic_segmentation(
        returned, target_sizes=[(_SIDE, _SIDE)], return_segmentation_scores=True
    )
    scores: Tensor = result["segmentation_scores"]
    return scores


@torch.no_grad()
def own_logits(network: Any, processor: Any) -> Tensor:
    """``(K, h, w)`` logits of the library for the photo, enlarged as its pipeline does."""
    pixels = processor(photo(), return_tensors="pt", do_resize=False)["pixel_values"]
    logits = network(pixel_values=pixels)["logits"]
    return torch.nn.functional.interpolate(logits, (_SIDE, _SIDE), mode="bilinear")[0]


def imported(folder: Path, **settings: Any) -> LoadedNetwork:
    """Import the network and read its checkpoint."""
    given: dict[str, Any] = {"classes": None, "normalization": None} | settings
    network = huggingface.load(model=str(folder), **given)
    return import_network(network, folder / "imported.ckpt")


def normalized(trained: LoadedNetwork) -> Tensor:
    """Return the photo as an image of the imported network, ``(1, 3, h, w)``."""
    rgb = torch.from_numpy(photo()).permute(2, 0, 1) / 255
    mean, std = (
        torch.tensor(values)[:, None, None]
        for values in (trained.normalization.mean, trained.normalization.std)
    )
    return ((rgb - mean) / std)[None]


@torch.no_grad()
def imported_scores(trained: LoadedNetwork) -> Tensor:
    """Return scores ``(K, h, w)`` of the imported network for the photo."""
    scores: Tensor = trained.network(normalized(trained))[0]
    return scores


def assert_same(scores: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(scores, expected, rtol=0, atol=1e-4)


def tokenizer(folder: Path) -> Any:
    """Write CLIP's tokenizer with single letters as its vocabulary."""
    letters = sorted(set("the task is semantic or panoptic") - {" "})
    words = [*letters, *(f"{c}</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    made = transformers.CLIPTokenizer(vocab={w: k for k, w in enumerate(words)}, merges=[])
    made.save_pretrained(folder)
    return made


def task_inputs(tokenizer: Any, processor: Any, task: str) -> dict[str, Tensor]:
    """Return OneFormer's task as the library's processor tokenizes it."""
    both = transformers.OneFormerProcessor(processor, tokenizer, task_seq_length=24)
    return {"task_inputs": both(photo(), [task], return_tensors="pt")["task_inputs"]}


def change_json(path: Path, **changes: Any) -> None:
    """Change keys of an object in a JSON file; None removes a key."""
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({n: v for n, v in content.items() if v is not None}))
