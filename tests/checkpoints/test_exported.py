"""Exported networks compute the same, and say all that is needed to use them."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors.numpy import load_file
from safetensors.torch import save_file

from models import UNet, initialize
from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.export import SUFFIXES, Format, export_network
from tests.tasks.odd_networks import assert_same, scores_of, some_images
from tests.tasks.small_networks import NAMES, UNET, small_trained

FORMATS: tuple[Format, ...] = ("onnx", "safetensors")
NETWORKS: dict[str, dict[str, Any]] = {
    "unet": UNET,
    "unet, stride 32": {**UNET, "widths": [4, 4, 8, 8, 8, 8]},
    "hexunet": {"_target_": "models.HexUNet", "in_channels": 4, "num_classes": 5},
    "fcn": {"_target_": "models.FCNResNet", "in_channels": 4, "num_classes": 5, "depth": 50},
    "fcn, frozen statistics": {
        "_target_": "models.FCNResNet",
        "in_channels": 4,
        "num_classes": 5,
        "depth": 50,
        "frozen_statistics": True,
    },
    "deeplabv3": {
        "_target_": "models.widen_stem",
        "in_channels": 4,
        "network": {
            "_target_": "torchvision.models.segmentation.deeplabv3_mobilenet_v3_large",
            "num_classes": 5,
            "weights": None,
            "weights_backbone": None,
            "aux_loss": False,
        },
    },
    "smp": {
        "_target_": "segmentation_models_pytorch.Unet",
        "encoder_name": "resnet18",
        "encoder_weights": None,
        "in_channels": 4,
        "classes": 5,
    },
}


@pytest.fixture(scope="module")
def trained() -> TrainedNetwork:
    """A small UNet."""
    return small_trained()


@pytest.fixture(scope="module")
def files(trained: TrainedNetwork, tmp_path_factory: pytest.TempPathFactory) -> dict[Format, Path]:
    """It as files, not to be changed."""
    folder = tmp_path_factory.mktemp("exported")
    paths = {form: folder / f"net{SUFFIXES[form]}" for form in FORMATS}
    for form, path in paths.items():
        export_network(trained, path, form)
    return paths


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NETWORKS if name != "unet"])
def test_onnxruntime_computes_what_pytorch_does_for_every_network(
    name: str, tmp_path: Path
) -> None:
    trained = small_trained(NETWORKS[name], image_size=(64, 64))
    path = tmp_path / "net.onnx"
    written = export_network(trained, path, "onnx")
    assert written.trained.fixed_size is None
    _assert_onnxruntime_agrees(path, trained)


def test_onnxruntime_computes_what_pytorch_does(
    trained: TrainedNetwork, files: dict[Format, Path]
) -> None:
    assert load_trained(files["onnx"]).fixed_size is None
    _assert_onnxruntime_agrees(files["onnx"], trained)


def _assert_onnxruntime_agrees(path: Path, trained: TrainedNetwork) -> None:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [i.name for i in session.get_inputs()] == ["images"]
    assert [o.name for o in session.get_outputs()] == ["scores"]
    step = trained.size_multiple
    for count, size in ((1, (64, 96)), (5, (32 + step, 64))):
        images = some_images(trained, count, size)
        (scores,) = session.run(None, {"images": images.numpy()})
        assert_same(scores, scores_of(trained, images))


@pytest.mark.parametrize(
    "name",
    ["unet", *(pytest.param(n, marks=pytest.mark.slow) for n in NETWORKS if n != "unet")],
)
def test_safetensors_give_the_network_back(name: str, tmp_path: Path) -> None:
    trained = small_trained(NETWORKS[name], image_size=(64, 64))
    path = tmp_path / "net.safetensors"
    export_network(trained, path, "safetensors")
    again = load_trained(path)
    step = trained.size_multiple
    for count, size in ((1, (64, 96)), (3, (32 + step, 64))):
        images = some_images(trained, count, size)
        assert_same(scores_of(again, images), scores_of(trained, images))


@pytest.mark.parametrize("form", FORMATS)
def test_what_is_known_of_a_network_comes_back(
    form: Format, trained: TrainedNetwork, files: dict[Format, Path]
) -> None:
    path = files[form]
    again = load_trained(path)
    known = ("class_names", "inputs", "normalization", "level", "representation", "image_size")
    for name in (*known, "size_multiple", "fixed_size"):
        assert getattr(again, name) == getattr(trained, name)
    assert again.settings == (UNET if form == "safetensors" else None)
    assert not again.network.training
    assert isinstance(again.network, OnnxNetwork) == (form == "onnx")
    assert path.stat().st_mode & 0o777 == 0o644


def _metadata(path: Path) -> Any:
    """Read without this package's own code."""
    if path.suffix == ".onnx":
        text = next(p.value for p in onnx.load(path).metadata_props if p.key == "tangent_train")
    else:
        content = path.read_bytes()
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        text = header["__metadata__"]["tangent_train"]
    return json.loads(text)


@pytest.mark.parametrize("form", FORMATS)
def test_the_metadata_is_json_under_one_key(form: Format, files: dict[Format, Path]) -> None:
    assert _metadata(files[form]) == {
        "class_names": list(NAMES),
        "inputs": ["rgb", "depth"],
        "normalization": {"mean": [0.5, 0.4, 0.3, 1.1], "std": [0.2, 0.25, 0.3, 0.8]},
        "level": 5,
        "representation": {
            "_target_": "tangent_train.rendering.TangentRepresentation",
            "base_level": 0,
            "level": 5,
        },
        "image_size": [32, 32],
        "size_multiple": 4,
        "fixed_size": None,
        "settings": UNET if form == "safetensors" else None,
        "tangent_train_version": version("tangent-train"),
    }


def test_tensors_keep_their_names_for_other_programs(tmp_path: Path) -> None:
    trained = small_trained()
    trained.network.to(memory_format=torch.channels_last)
    path = tmp_path / "net.safetensors"
    export_network(trained, path, "safetensors")
    assert isinstance(trained.network.network, UNet)
    own = trained.network.network.state_dict()
    written = load_file(path)
    assert written.keys() == own.keys()
    for name, tensor in own.items():
        np.testing.assert_array_equal(written[name], tensor.numpy())
    fresh = UNet(4, 5, (4, 8, 8))
    assert initialize(fresh, path).share == 1  # what init_from= does


def test_a_safetensors_file_can_be_exported_again(
    trained: TrainedNetwork, files: dict[Format, Path], tmp_path: Path
) -> None:
    again = load_trained(files["safetensors"])
    export_network(again, tmp_path / "net.onnx", "onnx")
    images = some_images(trained, 2, (32, 36))
    scores = load_trained(tmp_path / "net.onnx").network(images).detach()
    assert_same(scores, scores_of(trained, images))


def test_a_computation_alone_cannot_be_exported_again(
    files: dict[Format, Path], tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match="checkpoint: found an exported network"):
        export_network(load_trained(files["onnx"]), tmp_path / "x.onnx", "onnx")


def test_onnx_files_of_others_are_told_apart(files: dict[Format, Path], tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    model = onnx.load(files["onnx"])
    text = model.metadata_props[0].value
    for value, message in (
        (None, "no 'tangent_train' in its metadata"),
        ("{", "no JSON in 'tangent_train' of its metadata"),
        ("3", "int instead of a mapping in 'tangent_train'"),
        (text.replace('"inputs"', '"input"'), "no inputs in 'tangent_train'"),
    ):
        del model.metadata_props[:]
        if value is not None:
            model.metadata_props.add(key="tangent_train", value=value)
        onnx.save(model, path)
        with pytest.raises(DataError, match=f"net.onnx: found .*{message}"):
            load_trained(path)


def test_safetensors_of_others_are_told_apart(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(2)}, tmp_path / "net.safetensors")
    with pytest.raises(DataError, match="found no 'tangent_train' in its metadata"):
        load_trained(tmp_path / "net.safetensors")
    with pytest.raises(DataError, match="no such file"):
        load_trained(tmp_path / "other.safetensors")
    (tmp_path / "net.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0nothing")
    with pytest.raises(DataError, match="an unreadable file"):
        load_trained(tmp_path / "net.safetensors")
