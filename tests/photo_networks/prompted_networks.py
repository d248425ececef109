"""Tiny CLIPSeg and SAM 3 with random weights, which read single letters."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from tests.photo_networks import huggingface_networks as networks

SIZES: dict[str, Any] = {
    "hidden_size": 16,
    "intermediate_size": 16,
    "num_attention_heads": 2,
    "num_hidden_layers": 2,
}


def _text(**more: Any) -> dict[str, Any]:
    return SIZES | {"vocab_size": 64, "max_position_embeddings": 16} | more


def clipseg(end: int) -> networks.Made:
    hf = networks.transformers
    vision = SIZES | {"num_hidden_layers": 3, "image_size": 64, "patch_size": 16}
    config = hf.CLIPSegConfig(
        text_config=_text(eos_token_id=end),  # its state is the embedding
        vision_config=vision,
        projection_dim=8,
        extract_layers=[0, 1, 2],
        reduce_dim=8,
        decoder_num_attention_heads=2,
        decoder_intermediate_size=8,
    )
    size = {"height": 64, "width": 64}
    return hf.CLIPSegForImageSegmentation(config), hf.ViTImageProcessor(size=size)


def sam3() -> networks.Made:
    hf = networks.transformers
    layers = {"hidden_size": 16, "num_attention_heads": 2}
    backbone = SIZES | {"model_type": "sam3_vit_model", "image_size": 56, "patch_size": 14}
    backbone |= {"window_size": 2, "global_attn_indexes": [1], "pretrain_image_size": 56}
    detr = layers | {"num_layers": 1, "intermediate_size": 16}
    config = hf.Sam3Config(
        vision_config={
            "backbone_config": backbone,
            "fpn_hidden_size": 16,
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
        },
        text_config=_text(model_type="clip_text_model", projection_dim=8),
        geometry_encoder_config=detr,
        detr_encoder_config=detr,
        detr_decoder_config=detr | {"num_queries": 5},
        mask_decoder_config=layers,
    )
    size = {"height": 56, "width": 56}
    return hf.Sam3Model(config), hf.Sam3ImageProcessor(size=size)


def saved_clipseg(folder: Path) -> Any:
    """Save a CLIPSeg with its tokenizer."""
    end = networks.tokenizer(folder).eos_token_id
    network, _ = networks.saved(partial(clipseg, end), folder)
    return network


def saved_sam3(folder: Path) -> networks.Made:
    """Save a SAM 3 with its tokenizer, whose scores differ and which finds objects."""
    network, processor = networks.saved(sam3, folder, noise=0.4)
    networks.tokenizer(folder)
    last = network.detr_decoder.presence_head.layer3
    last.weight.data.zero_()
    last.bias.data.fill_(2)  # objects are there
    for parameter in network.dot_product_scoring.text_proj.parameters():
        parameter.data.mul_(-0.3)
    network.save_pretrained(folder)
    return network, processor
