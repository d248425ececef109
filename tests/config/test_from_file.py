"""Networks and representations of a file: what is built, and what is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from models import UNet
from tangent_train.config.from_file import build_from_file, without_weights
from tangent_train.errors import DataError
from tangent_train.rendering import TangentRepresentation

FILE = Path("x.ckpt")
UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 4, "widths": [4, 8]}


def test_networks_and_representations_are_built() -> None:
    assert isinstance(build_from_file(UNET, "network", FILE), UNet)
    views = {
        "_target_": "tangent_train.rendering.TangentRepresentation",
        "base_level": 0,
        "level": 4,
    }
    assert isinstance(build_from_file(views, "representation", FILE), TangentRepresentation)
    partial = {"_target_": "models.mesh_operators", "_partial_": True, "level": 2}
    assert build_from_file(partial, "table", FILE).keywords == {"level": 2}


@pytest.mark.parametrize(
    "section",
    [
        {
            "_target_": "torchvision.models.segmentation.deeplabv3_mobilenet_v3_large",
            "weights": "DEFAULT",
            "weights_backbone": "https://localhost/x.pth",
            "num_classes": 4,
        },
        {
            "_target_": "segmentation_models_pytorch.Unet",
            "encoder_name": "resnet18",
            "encoder_weights": "imagenet",
        },
        {
            "_target_": "timm.create_model",
            "model_name": "resnet18",
            "pretrained": True,
            "checkpoint_path": "evil.pth",
        },
    ],
)
def test_weights_are_never_fetched(section: dict[str, Any], monkeypatch: Any) -> None:
    def fetch(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("torch.hub.load_state_dict_from_url", fetch)
    monkeypatch.setattr("torch.load", fetch)
    with torch.device("meta"):
        network = build_from_file({"_target_": "torch.nn.Sequential"}, "network", FILE)
        assert isinstance(network, nn.Sequential)
        assert isinstance(build_from_file(section, "network", FILE), nn.Module)


@pytest.mark.parametrize(
    "target",
    [
        *("os.system", "subprocess.run", "builtins.eval", "torch.load", "torch.hub.load"),
        *("models.import_module", "models.initialize", "models.UNet.__init__", "models.unet.nn"),
        *("torchvision.models.get_model", "torchvision.models._api.inspect.os.system"),
        *("timm.models.load_checkpoint", "timm.models.helpers.torch.load", "timm.absent"),
        *("segmentation_models_pytorch.from_pretrained", "tangent_train.rendering.tables"),
        *(
            "tangent_train.files.write_text",
            "datamodules.synthrooms.datamodule.SynthRooms",
            "lightning.Trainer",
            3,
            None,
        ),
    ],
)
def test_nothing_else_is_called(target: Any) -> None:
    with pytest.raises(DataError, match=r"^x\.ckpt: found network"):
        build_from_file({"_target_": target}, "network", FILE)
    with pytest.raises(DataError, match=r"^x\.ckpt: found network"):
        build_from_file(UNET | {"widths": {"_target_": target}}, "network", FILE)


@pytest.mark.parametrize(
    "value",
    [
        *(
            "/etc/passwd",
            "../x",
            "https://localhost",
            "hf-hub:a/b",
            "local-dir:x",
            "${oc.env:HOME}",
        ),
        *("x\n", "a;b", b"x", {1}, ["a/b"], {"name": "a/b"}),
    ],
)
def test_texts_are_words(value: Any) -> None:
    section = {"_target_": "timm.create_model", "model_name": value}
    with pytest.raises(DataError, match=r"^x\.ckpt: found network\.model_name.*numbers and words"):
        build_from_file(section, "network", FILE)


def test_arguments_that_the_class_does_not_take_are_refused() -> None:
    for more in ({"depth": 3}, {"_args_": [1]}, {"widths": 8}):
        with pytest.raises(DataError, match=r"^x\.ckpt: found network cannot be built"):
            build_from_file(UNET | more, "network", FILE)


class Own(nn.Module):
    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path


def test_packages_of_the_user_are_trusted_by_name() -> None:
    section = {"_target_": f"{__name__}.Own", "path": "a/b"}
    with pytest.raises(DataError, match=rf"trust={__name__}\.Own"):
        build_from_file(section, "network", FILE)
    for trust in (__name__, f"{__name__}.Own"):
        assert build_from_file(section, "network", FILE, [trust]).path == "a/b"
    with pytest.raises(DataError):
        build_from_file(section, "network", FILE, [f"{__name__}.Ow"])


def test_weights_inside_a_section_become_null() -> None:
    section = {"network": {"weights": "x", "pretrained_cfg": {"url": "x"}, "width": 3}}
    assert without_weights(section) == {
        "network": {"weights": None, "pretrained_cfg": None, "width": 3}
    }
