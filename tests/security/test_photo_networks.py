"""Photo networks: an import runs, fetches and reads nothing that a folder names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import segmentation_models_pytorch  # type: ignore[import-untyped]
import torch

from tangent_train.config.build import build_from_config
from tangent_train.config.from_file import build_from_file
from tangent_train.errors import DataError, SettingError
from tangent_train.photo_networks import libraries
from tests.photo_networks import huggingface_networks as networks
from tests.security.attacks import CANARY
from tests.security.watch import watched

_GPT2 = {"model_type": "timm_backbone", "backbone": "gpt2"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a SegFormer, saved by transformers."""
    networks.saved(networks.segformer, tmp_path / "net")
    return tmp_path / "net"


def test_an_image_processor_runs_and_fetches_nothing(folder: Path, tmp_path: Path) -> None:
    networks.change_json(
        folder / "preprocessor_config.json",
        auto_map={"AutoImageProcessor": f"{CANARY}.Processor"},
        image_processor_type=f"{CANARY}Processor",
    )
    (folder / f"{CANARY}.py").write_text("raise SystemExit")
    with watched(tmp_path / "forbidden") as happened:
        networks.imported(folder)
    assert happened == []


@pytest.mark.parametrize("size", [{"height": 31623, "width": 31623}, 10**9], ids=str)
def test_an_image_processor_of_huge_images_is_refused(folder: Path, size: Any) -> None:
    networks.change_json(folder / "preprocessor_config.json", size=size)
    with pytest.raises(DataError, match=r"preprocessor_config\.json: found an image size of 1?3?"):
        networks.imported(folder)


def _with(content: Any, place: tuple[str, ...], more: dict[str, Any]) -> Any:
    """Return a copy with additional keys in a section."""
    if not place:
        return content | more
    return content | {place[0]: _with(content[place[0]], place[1:], more)}


@pytest.mark.parametrize(
    "backbone",
    [
        _GPT2,
        {"model_type": "timm_backbone", "backbone": f"hf-hub:{CANARY}/x"},
        # A class whose own network inside is of another kind than it declares.
        {"model_type": "sam3", "vision_config": _GPT2},
        {"model_type": "dpt", "backbone": "gpt2", "use_timm_backbone": False},
        "gpt2",
    ],
)
def test_backbones_are_not_looked_up(backbone: Any, folder: Path, tmp_path: Path) -> None:
    path = folder / "config.json"
    networks.change_json(path, model_type="upernet", backbone_config=backbone)
    config = {"model_type": "upernet", "backbone_config": backbone}
    network = {"_target_": "models.HuggingFaceNetwork", "config": config, "num_classes": 2}
    uses: tuple[Callable[[], Any], ...] = (
        lambda: networks.imported(folder),
        lambda: build_from_file(network, "network", path),
    )
    for use in uses:
        refused = pytest.raises((DataError, SettingError), match=f"network|{CANARY}")
        with watched(tmp_path / "forbidden") as happened, torch.device("meta"), refused:
            use()
        assert happened == []


def fetching() -> None:
    """Build a network that needs a file from the hub, whose address has no server."""
    huggingface_hub.hf_hub_download("someone/net", "config.json", endpoint="http://127.0.0.1:9")


def test_the_hub_is_offline_for_files_alone(tmp_path: Path) -> None:
    section = {"_target_": f"{__name__}.fetching"}
    with watched(tmp_path / "forbidden") as happened:
        with pytest.raises(DataError, match=r"x\.ckpt: found network cannot be built"):
            build_from_file(section, "network", tmp_path / "x.ckpt", [section["_target_"]])
        assert happened == []
        with pytest.raises(OSError):  # noqa: PT011 - any error of the connection
            build_from_config(section, "network")
        assert happened


def test_a_file_names_an_encoder_and_nothing_is_fetched(tmp_path: Path) -> None:
    folder, classes = tmp_path / "net", tmp_path / "classes.json"
    classes.write_text('["sky"]')
    small = {"encoder_depth": 3, "decoder_channels": (8, 8, 8)}
    network = segmentation_models_pytorch.Unet("resnet18", encoder_weights=None, **small)
    network.save_pretrained(folder)
    with watched(tmp_path / "forbidden") as happened:
        with pytest.raises(SettingError, match=r"no default for resnet18 .*expected imagenet"):
            libraries.load_smp(model=str(folder), classes=classes, normalization=None)
        loaded = libraries.load_smp(model=str(folder), classes=classes, normalization="imagenet")
        assert tuple(loaded.score_names) == ("sky",)
    assert happened == []
