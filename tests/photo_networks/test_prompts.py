"""Networks that find what a text names: classes are prompts, scores are those of the library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import SettingError
from tests.photo_networks import huggingface_networks as networks

SIZES: dict[str, Any] = {
    "hidden_size": 16,
    "intermediate_size": 16,
    "num_attention_heads": 2,
    "num_hidden_layers": 2,
}
PROMPTS = {"seat": ["mast", "eskis"], "tah": ["tah"]}
TEXTS = ["mast", "eskis", "tah"]


def _text(**more: Any) -> dict[str, Any]:
    # Positions of the end token of `networks.tokenizer`.
    return SIZES | {"vocab_size": 64, "max_position_embeddings": 16, "eos_token_id": 27} | more


def clipseg() -> networks.Made:
    hf = networks.transformers
    vision = SIZES | {"num_hidden_layers": 3, "image_size": 64, "patch_size": 16}
    config = hf.CLIPSegConfig(
        text_config=_text(),
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


def _tokens(folder: Path, length: int = 16) -> Any:
    tokenizer = networks.transformers.AutoTokenizer.from_pretrained(folder)
    how = {"padding": "max_length", "max_length": length, "return_tensors": "pt"}
    tokens = tokenizer(TEXTS, **how)
    return {name: tokens[name] for name in ("input_ids", "attention_mask")}


def _images(trained: Any, side: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, 3, side, side, generator=generator)


@torch.no_grad()
def test_scores_of_clipseg_are_those_of_the_library(tmp_path: Path) -> None:
    network, _ = networks.saved(clipseg, tmp_path)
    networks.tokenizer(tmp_path)
    trained = networks.imported(tmp_path, prompts=PROMPTS, threshold=0.6)
    assert trained.class_names == ("unknown", "seat", "tah")
    assert (trained.things, trained.fixed_size) == ((), (64, 64))
    images = _images(trained, 64)
    expected = torch.stack(
        [
            network(pixel_values=image.expand(3, -1, -1, -1), **_tokens(tmp_path)).logits
            for image in images
        ]
    )
    scores = trained.network(images)
    networks.assert_same(scores[:, 0], expected[:, :2].amax(1))
    networks.assert_same(scores[:, 1], expected[:, 2])
    networks.assert_same(scores[:, 2].sigmoid(), torch.full_like(scores[:, 2], 0.6))
    again = load_network(tmp_path / "imported.ckpt")
    networks.assert_same(again.network(images), scores)
    names = again.module.state_dict()
    assert not any("text" in name for name in names)


@torch.no_grad()
def test_scores_and_objects_of_sam_are_those_of_the_library(tmp_path: Path) -> None:
    network, processor = networks.saved(sam3, tmp_path, noise=0.4)
    networks.tokenizer(tmp_path)
    last = network.detr_decoder.presence_head.layer3
    last.weight.zero_()
    last.bias.fill_(2)  # objects are there
    for parameter in network.dot_product_scoring.text_proj.parameters():
        parameter.mul_(-0.3)
    network.save_pretrained(tmp_path)
    trained = networks.imported(tmp_path, prompts=PROMPTS)
    assert trained.things == ("seat", "tah")
    images = _images(trained, 56)
    returned = trained.network(images)
    scores, segments = returned["out"], returned["segments"]
    shares, found = [], []
    for k in range(3):
        tokens = {
            name: values[k : k + 1].expand(2, -1) for name, values in _tokens(tmp_path).items()
        }
        output = network(pixel_values=images, **tokens)
        sizes = [(56, 56)] * 2
        maps = processor.post_process_semantic_segmentation(
            output, target_sizes=sizes, return_segmentation_scores=True
        )
        shares.append(torch.stack([each["segmentation_scores"].squeeze() for each in maps]))
        found.append(processor.post_process_instance_segmentation(output, target_sizes=sizes))
    networks.assert_same(scores[:, 0].sigmoid(), torch.maximum(shares[0], shares[1]))
    networks.assert_same(scores[:, 1].sigmoid(), shares[2])
    for image, of_image in enumerate(segments):
        objects = [
            (float(score), mask.bool(), int(prompt == 2))
            for prompt in range(3)
            for score, mask in zip(
                found[prompt][image]["scores"], found[prompt][image]["masks"], strict=True
            )
        ]
        objects.sort(key=lambda each: each[0])
        assert len(objects) == len(of_image.scores) > 1
        assert np.allclose(of_image.scores, [score for score, _, _ in objects], atol=1e-4)
        assert of_image.classes.tolist() == [label for _, _, label in objects]
        front = torch.zeros(56, 56)
        for number, (_, mask, _) in enumerate(objects, start=1):
            front[mask] = number
        assert torch.equal(of_image.numbers, front.int())


def test_prompts_of_a_file(tmp_path: Path) -> None:
    networks.saved(clipseg, tmp_path)
    networks.tokenizer(tmp_path)
    (tmp_path / "prompts.txt").write_text("mast\n\ntah \n")
    trained = networks.imported(tmp_path, prompts=[str(tmp_path / "prompts.txt")])
    assert trained.class_names == ("unknown", "mast", "tah")
    with pytest.raises(SettingError, match="prompts: found none; expected a text for each class"):
        networks.imported(tmp_path, prompts=[])
    networks.saved(networks.segformer, tmp_path / "other")
    with pytest.raises(SettingError, match="model_type: found 'segformer'; expected 'clipseg'"):
        networks.imported(tmp_path / "other", prompts=["mast"])
