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
from tests.photo_networks.prompted_networks import saved_clipseg, saved_sam3
from tests.running import composed_settings

PROMPTS = {"seat": ["mast", "eskis"], "tah": ["tah"]}
TEXTS = ["mast", "eskis", "tah"]


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
    network = saved_clipseg(tmp_path)
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
    assert not torch.allclose(expected[:, 0], expected[:, 1], atol=1e-3)  # the text is read
    again = load_network(tmp_path / "imported.ckpt")
    networks.assert_same(again.network(images), scores)


@torch.no_grad()
def test_scores_and_objects_of_sam_are_those_of_the_library(tmp_path: Path) -> None:
    network, processor = saved_sam3(tmp_path)
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


def test_other_prompts_and_threshold(tmp_path: Path) -> None:
    saved_clipseg(tmp_path)
    expected = networks.imported(tmp_path, prompts=PROMPTS, threshold=0.6)
    trained = networks.imported(tmp_path, prompts={"kite": ["kite"]})
    changed = trained.prompted(PROMPTS, 0.6)
    assert changed.class_names == expected.class_names
    assert (changed.groups, changed.settings) == (expected.groups, expected.settings)
    images = _images(trained, 64)
    scores = changed.network(images)
    assert torch.equal(scores, expected.network(images))
    networks.assert_same(trained.prompted("tah").network(images)[:, 0], scores[:, 1])
    with pytest.raises(ValueError, match="a text for each class"):
        trained.prompted({"seat": []})


def test_texts_of_classes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "prompts.txt").write_text("mast\n\ntah \n")
    (tmp_path / "mast").write_text("a file, not its texts")
    common = "library=huggingface", "model=net", "output=net.ckpt"
    for given, expected in {
        "prompts.txt": {"mast": ["mast"], "tah": ["tah"]},
        "mast": {"mast": ["mast"]},
        "[mast,picture frame]": {"mast": ["mast"], "picture frame": ["picture frame"]},
        "{seat: [mast, eskis], tah: tah}": PROMPTS,
    }.items():
        assert composed_settings("import", *common, f"prompts={given}").prompts == expected
    with pytest.raises(SettingError, match=r"prompts: .* expected a text"):
        composed_settings("import", *common, "prompts=[]")


def test_networks_without_text_are_refused(tmp_path: Path) -> None:
    networks.saved(networks.segformer, tmp_path)
    with pytest.raises(SettingError, match="a network without text"):
        networks.imported(tmp_path).prompted(["mast"])
    networks.tokenizer(tmp_path)
    with pytest.raises(SettingError, match="found 'segformer'; expected 'clipseg' or 'sam3'"):
        networks.imported(tmp_path, prompts=PROMPTS)
