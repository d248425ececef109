"""Networks of segmentation-models-pytorch, as its ``save_pretrained`` writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import segmentation_models_pytorch  # type: ignore[import-untyped]
import torch
from segmentation_models_pytorch import encoders

from tangent_train.errors import DataError, SettingError
from tangent_train.inference.photo_networks import PhotoNetwork, import_network, smp
from tests.inference.photo_networks.huggingface_networks import change_json, imported_scores, photo
from tests.security.watch import watched

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
    return smp.load(model=str(folder), classes=classes, normalization=normalization)


@torch.no_grad()
def test_its_own_scores(folder: Path, tmp_path: Path) -> None:
    """Softmax of ours are the probabilities of the library."""
    own = segmentation_models_pytorch.from_pretrained(str(folder)).eval()
    preprocess = encoders.get_preprocessing_fn("tu-mobilenetv3_small_050.lamb_in1k")
    pixels = torch.from_numpy(preprocess(photo())).permute(2, 0, 1)[None].float()
    trained = import_network(_load(folder), tmp_path / "net.ckpt")
    scores = imported_scores(trained)
    torch.testing.assert_close(scores.softmax(dim=0), own(pixels)[0], rtol=0, atol=1e-4)
    assert trained.class_names == ("unknown", *NAMES)


@pytest.mark.parametrize("largest", [1, 255])
def test_the_normalization_of_an_encoder(
    largest: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the library applies it to images from 0 to 255."""
    given = {
        "mean": [0.5 * largest, 0.4 * largest, 0.3 * largest],
        "std": [0.2 * largest, 0.1 * largest, 0.3 * largest],
        "input_range": [0, largest],
        "input_space": "RGB",
    }
    monkeypatch.setattr(encoders, "get_preprocessing_params", lambda *_: given)
    normalization = _load(folder).normalization
    expected = encoders.preprocess_input(photo().astype(float), **given)
    ours = (photo() / 255 - normalization.mean) / normalization.std
    torch.testing.assert_close(torch.from_numpy(ours), torch.from_numpy(expected))
    given["input_space"] = "BGR"
    with pytest.raises(SettingError, match="takes BGR; expected imagenet, unit"):
        _load(folder)


def test_a_file_names_an_encoder_and_nothing_is_fetched(folder: Path, tmp_path: Path) -> None:
    small = {"encoder_depth": 3, "decoder_channels": (8, 8, 8), "classes": len(NAMES)}
    network = segmentation_models_pytorch.Unet("resnet18", encoder_weights=None, **small)
    network.save_pretrained(folder)
    with watched(tmp_path / "forbidden") as happened:
        with pytest.raises(SettingError, match=r"none known of resnet18 .*expected imagenet, unit"):
            _load(folder)
        assert tuple(_load(folder, "imagenet").score_names) == tuple(NAMES)
    assert happened == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"_model_class": "encoders"}, "segmentation_models_pytorch.encoders, which would be"),
        ({"encoder_name": "tu-hf-hub:someone/net"}, "encoder_name='tu-hf-hub"),
        ({"aux_params": {"classes": 4}}, "aux_params="),
        ({"classes": 1}, "found a network with one score"),
        ({"decoder_channels": [8, 8, 16]}, "expected the tensors of Unet"),
    ],
)
def test_settings_that_do_not_fit(changes: dict[str, Any], message: str, folder: Path) -> None:
    change_json(folder / "config.json", **changes)
    with pytest.raises(DataError, match=message):
        _load(folder, "imagenet")
