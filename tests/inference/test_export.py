"""Exported networks compute the same scores and contain all settings; else they are not written."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import pytest
import torch
from safetensors import safe_open

from datamodules.core.label_map import DISTANCE
from models.onnx_network import OnnxNetwork
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import SettingError
from tangent_train.inference.export import SUFFIXES, export_network
from tests.tasks.odd_networks import assert_same, config_section, scores_of, some_images
from tests.tasks.small_networks import NAMES, UNET, small_trained


@pytest.fixture(scope="module")
def trained() -> LoadedNetwork:
    """A small UNet."""
    return small_trained()


@pytest.fixture(scope="module")
def files(trained: LoadedNetwork, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Its exported files by suffix; tests must not change them."""
    folder = tmp_path_factory.mktemp("exported")
    paths = {suffix: folder / f"net{suffix}" for suffix in SUFFIXES}
    for path in paths.values():
        assert export_network(trained, path).difference < 1e-5
    return paths


def _metadata(path: Path) -> Any:
    """Run a file without code of this package."""
    if path.suffix == ".onnx":
        return json.loads(onnx.load(path).metadata_props[0].value)
    with safe_open(path, "numpy") as file:
        return json.loads(file.metadata()["tangent_train"])


def test_onnxruntime_computes_what_pytorch_does(
    trained: LoadedNetwork, files: dict[str, Path]
) -> None:
    session = onnxruntime.InferenceSession(files[".onnx"], providers=["CPUExecutionProvider"])
    assert [i.name for i in session.get_inputs()] == ["images"]
    assert [o.name for o in session.get_outputs()] == ["scores"]
    for count, size in ((1, (64, 96)), (5, (36, 64))):
        images = some_images(trained, count, size)
        (scores,) = session.run(None, {"images": images.numpy()})
        assert_same(scores, scores_of(trained, images))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_everything_known_of_a_network_comes_back(
    suffix: str, trained: LoadedNetwork, files: dict[str, Path]
) -> None:
    path, again = files[suffix], load_network(files[suffix])
    settings = UNET if suffix == ".safetensors" else None
    assert again.plain() == trained.plain() | {"settings": settings}
    assert isinstance(again.module, OnnxNetwork) == (suffix == ".onnx")
    assert not again.network.training
    assert path.stat().st_mode & 0o777 == 0o644
    described = _metadata(path)
    assert described == again.plain()
    assert described["class_names"] == list(NAMES)
    assert described["normalization"]["mean"] == [0.5, 0.4, 0.3, 1.1]
    assert described["tangent_train_version"] == version("tangent-train")


def test_only_a_safetensors_file_can_be_exported_again(
    files: dict[str, Path], tmp_path: Path
) -> None:
    trained, trust = small_trained(config_section("Tied")), config_section("Tied").values()
    export_network(trained, tmp_path / "net.safetensors")
    export_network(load_network(tmp_path / "net.safetensors", trust), tmp_path / "net.onnx")
    images = some_images(trained, 2, (32, 36))
    scores = load_network(tmp_path / "net.onnx").network(images).detach()
    assert_same(scores, scores_of(trained, images))
    with pytest.raises(SettingError, match="an exported network contains only"):
        export_network(load_network(files[".onnx"]), tmp_path / "x.onnx")


@pytest.mark.parametrize(
    ("network", "size", "fixed", "suffix"),
    [("Tied", (9, 7), None, ".safetensors"), ("OneSize", (24, 40), (24, 40), ".onnx")],
)
def test_networks_that_are_hard_to_export_are_exported(
    network: str,
    size: tuple[int, int],
    fixed: tuple[int, int] | None,
    suffix: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Tied tensors, and one size only."""
    image_size = fixed or (32, 32)
    trained = small_trained(config_section(network), image_size=image_size)
    path = tmp_path / f"net{suffix}"
    export_network(trained, path)
    again = load_network(path, config_section(network).values())
    assert (again.fixed_size, again.image_size) == (fixed, image_size)
    images = some_images(trained, 3, size)
    assert_same(again.network(images).detach(), scores_of(trained, images))
    assert capfd.readouterr() == ("", ""), "the exporter is quiet"
    assert logging.getLogger("anybody").isEnabledFor(logging.WARNING)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_depth_networks_are_exported_and_read_back(suffix: str, tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "class_names": (),
        "predicts": DISTANCE,
        "depth_kind": "relative_disparity",
    }
    trained = replace(small_trained(UNET | {"num_classes": 1}), **changes)
    path = tmp_path / f"net{suffix}"
    assert export_network(trained, path).difference < 1e-5
    again = load_network(path)
    assert (again.depth_kind, again.predicts) == ("relative_disparity", DISTANCE)
    images = some_images(trained, 2, (36, 64))
    assert_same(again.network(images).detach(), scores_of(trained, images))
    if suffix == ".onnx":
        (output,) = onnxruntime.InferenceSession(path).get_outputs()
        assert output.name == "depth"


def test_a_confidence_is_exported_to_safetensors_only(tmp_path: Path) -> None:
    changes: dict[str, Any] = {"class_names": (), "predicts": DISTANCE, "depth_kind": "metric_z"}
    trained = replace(small_trained(config_section("Sure")), **changes)
    with pytest.raises(SettingError, match="network: found further outputs"):
        export_network(trained, tmp_path / "net.onnx")
    again = export_network(trained, tmp_path / "net.safetensors").loaded
    images = some_images(trained, 2, (8, 12))
    returned, expected = (each.network(images) for each in (again, trained))
    assert torch.equal(returned["confidence"], expected["confidence"])


def test_size_and_operators_of_a_file_can_be_chosen(tmp_path: Path) -> None:
    trained = small_trained(config_section("Tied"))
    path = tmp_path / "net.onnx"
    export_network(trained, path, image_size=(7, 9), opset=18)
    again = load_network(path)
    assert (again.fixed_size, again.image_size) == ((7, 9), (32, 32))
    shape = onnxruntime.InferenceSession(path).get_inputs()[0].shape
    assert shape == ["batch", 4, 7, 9]
    assert {o.domain: o.version for o in onnx.load(path).opset_import}[""] == 18
    with pytest.raises(Exception, match="invalid dimensions"):
        again.network(some_images(trained, 1, (5, 9)))


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ("Looking", r"cannot be written .*safetensors file takes every network"),
        ("Tracing", "its output differs from PyTorch's"),
    ],
)
def test_files_that_compute_other_scores_are_refused(
    network: str, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    trained = small_trained(config_section(network))
    path = tmp_path / "net.onnx"
    path.write_text("before")
    with pytest.raises(SettingError, match=message):
        export_network(trained, path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
    assert capfd.readouterr() == ("", "")
