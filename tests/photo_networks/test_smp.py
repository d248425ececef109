"""Networks of segmentation-models-pytorch, saved by ``save_pretrained``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import segmentation_models_pytorch  # type: ignore[import-untyped]
import torch
from segmentation_models_pytorch import encoders

from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import DataError, SettingError
from tangent_train.heads import ClassesHead
from tangent_train.photo_networks import PhotoNetwork, import_network, libraries
from tests.photo_networks.huggingface_networks import change_json, imported_scores, photo

NAMES = ["wall", "floor", "sky"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    network = segmentation_models_pytorch.Unet(
        "tu-mobilenetv3_small_050.lamb_in1k",
        encoder_weights=None,
        encoder_depth=3,
        decoder_channels=(8, 8, 8),
        classes=len(NAMES),
        activation="softmax2d",
    )
    network.save_pretrained(tmp_path / "net")
    (tmp_path / "classes.json").write_text(json.dumps(NAMES))
    return tmp_path / "net"


def _load(folder: Path, normalization: Any = None) -> PhotoNetwork:
    classes = folder.parent / "classes.json"
    return libraries.load_smp(str(folder), classes=classes, normalization=normalization)


@torch.no_grad()
def test_scores_are_those_of_the_library(folder: Path, tmp_path: Path) -> None:
    """The softmax of the scores equals the library's probabilities."""
    original = segmentation_models_pytorch.from_pretrained(str(folder)).eval()
    preprocess = encoders.get_preprocessing_fn("tu-mobilenetv3_small_050.lamb_in1k")
    pixels = torch.from_numpy(preprocess(photo())).permute(2, 0, 1)[None].float()
    trained = import_network(_load(folder), tmp_path / "net.ckpt")
    scores = imported_scores(trained)
    torch.testing.assert_close(scores.softmax(dim=0), original(pixels)[0], rtol=0, atol=1e-4)
    assert trained.class_names == ("unknown", *NAMES)


@pytest.mark.parametrize("largest", [1, 255])
def test_the_normalization_is_that_of_the_encoder(
    largest: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library applies it to images from 0 to 255."""
    given = {
        "mean": [0.5 * largest, 0.4 * largest, 0.3 * largest],
        "std": [0.2 * largest, 0.1 * largest, 0.3 * largest],
        "input_range": [0, largest],
        "input_space": "RGB",
    }
    monkeypatch.setattr(encoders, "get_preprocessing_params", lambda *_: given)
    normalization = _load(folder).normalization
    expected = encoders.preprocess_input(photo().astype(float), **given)
    normalized = (photo() / 255 - normalization.mean) / normalization.std
    torch.testing.assert_close(torch.from_numpy(normalized), torch.from_numpy(expected))
    given["input_space"] = "BGR"
    with pytest.raises(SettingError, match=r"input_space.*expected imagenet, unit"):
        _load(folder)


@torch.no_grad()
@pytest.mark.parametrize("activation", [None, "sigmoid"])
def test_a_second_output_is_left_out(activation: str | None, tmp_path: Path) -> None:
    """A head for classes of the whole image is left out; the library's own threshold is ½."""
    torch.manual_seed(0)
    aux = {"classes": 2, "dropout": 0.1}
    settings: dict[str, Any] = {"encoder_weights": None, "classes": 1, "aux_params": aux}
    original = segmentation_models_pytorch.Unet(
        "resnet18", activation=activation, **settings
    ).eval()

    def shares_of_original() -> torch.Tensor:
        scores: torch.Tensor = original(_pixels())[0][0, 0]
        return scores if activation else scores.sigmoid()

    original.segmentation_head[0].bias -= shares_of_original().logit().mean()
    original.save_pretrained(tmp_path / "net")
    (tmp_path / "classes.json").write_text(json.dumps(["sky"]))
    trained = import_network(_load(tmp_path / "net", "unit"), tmp_path / "net.ckpt")
    shares, scores = shares_of_original(), imported_scores(trained)
    torch.testing.assert_close(scores.softmax(dim=0)[0], shares, rtol=0, atol=1e-4)
    labels = ClassesHead(trained.class_names).labels_of(scores.argmax(dim=0))
    assert 0.2 < float((shares > 0.5).float().mean()) < 0.8
    assert torch.equal(labels == 1, shares > 0.5)


def test_a_network_of_one_size_gets_images_of_this_size(tmp_path: Path) -> None:
    """DPT on a vision transformer for 224 × 224."""
    settings: dict[str, Any] = {"encoder_weights": None, "classes": len(NAMES), "encoder_depth": 2}
    settings |= {"encoder_output_indices": [0, 1], "decoder_intermediate_channels": (8, 8)}
    settings |= {"decoder_fusion_channels": 8}
    original = segmentation_models_pytorch.DPT("tu-vit_tiny_patch16_224.augreg_in21k", **settings)
    original.eval().save_pretrained(tmp_path / "net")
    (tmp_path / "classes.json").write_text(json.dumps(NAMES))
    network = _load(tmp_path / "net", "unit")
    with pytest.raises(SettingError, match=r"image of 512 × 512 .* set image_size=\[rows"):
        import_network(network, tmp_path / "net.ckpt")
    import_network(network, tmp_path / "net.ckpt", image_size=(224, 224), levels=9, base_level=0)
    trained = load_network(tmp_path / "net.ckpt")
    assert (trained.fixed_size, trained.image_size) == ((224, 224), (512, 512))
    images = torch.rand(1, 3, 224, 448)
    with torch.no_grad():
        expected = torch.cat([original(images[..., :224]), original(images[..., 224:])], dim=-1)
        torch.testing.assert_close(trained.network(images), expected, rtol=0, atol=1e-4)


def _pixels() -> torch.Tensor:
    return torch.from_numpy(photo()).permute(2, 0, 1)[None] / 255


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"_model_class": "encoders"}, "segmentation_models_pytorch.encoders, which would be"),
        ({"encoder_name": "tu-hf-hub:someone/net"}, "encoder_name='tu-hf-hub"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    changes: dict[str, Any], message: str, folder: Path
) -> None:
    change_json(folder / "config.json", **changes)
    with pytest.raises(DataError, match=message):
        _load(folder, "imagenet")
