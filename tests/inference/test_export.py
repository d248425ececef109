"""What an exporter has a hard time with, and that nothing half is ever left."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from models import UNet
from tangent_train.checkpoints.trained import load_trained
from tangent_train.errors import SettingError
from tangent_train.inference import export as export_module
from tangent_train.inference.export import SUFFIXES, Format, export_network
from tests.tasks.odd_networks import assert_same, own, scores_of, some_images
from tests.tasks.small_networks import small_trained

FORMATS: tuple[Format, ...] = ("onnx", "safetensors")
REFUSED = "^format=onnx: found "


@pytest.mark.parametrize("form", FORMATS)
def test_tied_tensors(form: Format, tmp_path: Path) -> None:
    trained = small_trained(own("Tied"))
    path = tmp_path / f"net{SUFFIXES[form]}"
    export_network(trained, path, form)
    images = some_images(trained, 2, (9, 7))
    again = load_trained(path, own("Tied").values())
    assert_same(again.network(images).detach(), scores_of(trained, images))


@pytest.mark.parametrize("form", FORMATS)
def test_a_network_of_one_size_stays_one(form: Format, tmp_path: Path) -> None:
    trained = small_trained(own("OneSize"), image_size=(24, 40))
    path = tmp_path / f"net{SUFFIXES[form]}"
    assert export_network(trained, path, form).trained.fixed_size == (24, 40)
    again = load_trained(path, own("OneSize").values())
    assert again.fixed_size == (24, 40)
    images = some_images(trained, 3, (24, 40))
    assert_same(again.network(images).detach(), scores_of(trained, images))


def test_what_cannot_be_left_open_is_fixed_and_said(tmp_path: Path) -> None:
    trained = small_trained(own("TwoSizes"), image_size=(20, 40))
    assert trained.fixed_size is None
    again = export_network(trained, tmp_path / "net.onnx", "onnx").trained
    assert (again.fixed_size, again.image_size) == ((20, 40), (20, 40))
    images = some_images(trained, 4, (20, 40))
    assert_same(again.network(images).detach(), scores_of(trained, images))


def test_a_size_can_be_asked_for(tmp_path: Path) -> None:
    trained = small_trained(own("Tied"))
    path = tmp_path / "net.onnx"
    export_network(trained, path, "onnx", image_size=(7, 9))
    again = load_trained(path)
    assert (again.fixed_size, again.image_size) == ((7, 9), (32, 32))
    images = some_images(trained, 3, (7, 9))
    assert_same(again.network(images).detach(), scores_of(trained, images))
    shape = onnxruntime.InferenceSession(path).get_inputs()[0].shape
    assert shape == ["batch", 4, 7, 9]
    with pytest.raises(SettingError, match=r"found 1×4×32×32; expected batch×4×7×9"):
        again.network(some_images(trained, 1, (32, 32)))


@pytest.mark.parametrize("opset", [18, 21])
def test_the_operators_can_be_of_another_version(opset: int, tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    export_network(small_trained(own("Tied")), path, "onnx", opset=opset)
    assert {o.domain: o.version for o in onnx.load(path).opset_import}[""] == opset


@pytest.mark.parametrize("opset", [9, 999])
def test_versions_that_there_are_not_are_refused(
    opset: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SettingError, match=rf"^opset: found {opset}; expected \d\d"):
        export_network(small_trained(own("Tied")), tmp_path / "net.onnx", "onnx", opset=opset)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (
            "Looking",
            f"{REFUSED}a network that cannot be exported .*safetensors takes every network",
        ),
        ("Counting", r"found 1×4×32×32; expected 2×4×h×w"),
        ("Tracing", rf"{REFUSED}scores that differ by .*; expected the same, up to 0\.0001"),
    ],
)
def test_what_would_compute_something_else_is_refused(
    network: str, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    trained = small_trained(own(network))
    path = tmp_path / "net.onnx"
    path.write_text("before")
    with pytest.raises(SettingError, match=message):
        export_network(trained, path, "onnx")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
    assert capfd.readouterr() == ("", "")
    export_network(trained, tmp_path / "net.safetensors", "safetensors")


def test_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    trained = small_trained()
    network = trained.network.network
    assert isinstance(network, UNet)
    with torch.no_grad():
        network.head.weight[0] = torch.nan
    with pytest.raises(SettingError, match="differ by nan"):
        export_network(trained, tmp_path / "net.safetensors", "safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", FORMATS)
def test_nothing_is_said_and_logs_go_on(
    form: Format, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    export_network(small_trained(own("Tied")), tmp_path / f"net{SUFFIXES[form]}", form)
    assert capfd.readouterr() == ("", "")
    assert logging.getLogger("anybody").isEnabledFor(logging.WARNING)


def test_files_of_more_than_protobuf_holds_are_refused(tmp_path: Path) -> None:
    trained = small_trained()
    trained.network.network.further = nn.Linear(2**15, 2**14, device="meta")  # type: ignore[union-attr]
    with pytest.raises(SettingError, match=r"found a network of 2\.0 GiB.*format=safetensors"):
        export_network(trained, tmp_path / "net.onnx", "onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("form", "name", "settings", "message"),
    [
        ("tflite", "net.tflite", {}, r"format: found 'tflite'; expected onnx, safetensors\."),
        ("onnx", "net.pt", {}, r"output: found net\.pt; expected a name ending in \.onnx"),
        ("torchscript", "net.pt", {}, r"format: found 'torchscript'; expected onnx, safetensors\."),
        ("safetensors", "net.safetensors", {"opset": 18}, "opset: found 18; expected null"),
        ("safetensors", "net.safetensors", {"image_size": (32, 32)}, r"image_size: .*null"),
        ("onnx", "net.onnx", {"image_size": (32, 30)}, r"image_size: found \[32, 30\]; .* of 4"),
        ("onnx", "net.onnx", {"image_size": (0, 32)}, r"image_size: found \[0, 32\]"),
    ],
)
def test_settings_that_do_not_fit(
    form: Any, name: str, settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=f"^{message}"):
        export_network(small_trained(), tmp_path / name, form, **settings)
    assert list(tmp_path.iterdir()) == []


def test_another_size_of_a_network_of_one_is_refused(tmp_path: Path) -> None:
    trained = small_trained(own("OneSize"), image_size=(24, 40))
    with pytest.raises(SettingError, match=r"found \[24, 48\]; expected \[24, 40\]"):
        export_network(trained, tmp_path / "net.onnx", "onnx", image_size=(24, 48))


@pytest.mark.parametrize("package", ["onnx", "onnxruntime", "onnxscript"])
def test_packages_for_onnx_are_named(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    message = rf"found no package {package}; .* pip install 'tangent-train\[export\]'"
    with pytest.raises(SettingError, match=message):
        export_network(small_trained(), tmp_path / "net.onnx", "onnx")


def test_an_interrupted_export_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(export_module, "load_trained", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_network(small_trained(), tmp_path / "net.safetensors", "safetensors")
    assert list(tmp_path.iterdir()) == []
