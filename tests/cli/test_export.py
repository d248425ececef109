"""`tangent-export` as it is typed, and its page in the docs from top to bottom."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli import main
from tangent_train.inference import export as export_module
from tests.slow.documentation.markdown import commands, shown_files
from tests.slow.documentation.running import ROOT
from tests.tasks.small_networks import save_checkpoint

if TYPE_CHECKING:
    from numpy.typing import NDArray

PAGE = "docs/export.md"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run (1)") / "best=1.ckpt"
    task = save_checkpoint(path, "network.widths=[4,8]")
    content = torch.load(path, weights_only=True)
    with torch.no_grad():  # no class is the best everywhere
        scores = task(torch.randn(4, 4, 32, 32, generator=torch.Generator().manual_seed(0)))
    content["state_dict"]["network.head.bias"] -= scores.mean(dim=(0, 2, 3))
    torch.save(content, path)
    return path


def _export(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["tangent-export", *arguments])
    main.export()


@pytest.mark.parametrize("name", ["a, b.onnx", "model.safetensors", "new/folder/model.ONNX"])
def test_the_suffix_says_the_format(
    name: str,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    _export(monkeypatch, f"checkpoint={checkpoint}", f"output={name}")
    said, errors = capfd.readouterr()
    assert errors == ""
    path = tmp_path / name
    size = f"{path.stat().st_size / 1e6:.1f}"
    assert re.fullmatch(
        rf"{re.escape(name)}: {size} MB\n"
        r"images: any number of 4 channels, h×w, both multiples of 2; scores of 14 classes\n"
        r"largest difference to PyTorch: (\d\.\de[+-]\d\d), (\d\.\de[+-]\d\d) of the range of the "
        r"scores\n",
        said,
    )
    exported, trained = load_trained(path), load_trained(checkpoint)
    assert exported.class_names == trained.class_names
    images = torch.randn(3, 4, 16, 18)
    with torch.no_grad():
        torch.testing.assert_close(
            exported.network(images), trained.network(images), atol=1e-5, rtol=1e-5
        )
    kept = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert kept == [path]  # and no folder of Hydra's


def test_a_file_is_written_over_only_when_told(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "model.safetensors"
    output.write_text("mine")
    typed = [f"checkpoint={checkpoint}", f"output={output}"]
    with pytest.raises(SystemExit, match=r"^tangent-export: output: .*set overwrite=true\."):
        _export(monkeypatch, *typed)
    assert output.read_text() == "mine"
    _export(monkeypatch, *typed, "overwrite=true")
    assert load_trained(output).level == 4
    (tmp_path / "folder.onnx").mkdir()
    with pytest.raises(SystemExit, match=r"folder\.onnx, which exists; expected a new file\.$"):
        _export(monkeypatch, typed[0], f"output={tmp_path}/folder.onnx", "overwrite=true")


def test_a_size_is_said(
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "model.onnx"
    typed = [f"checkpoint={checkpoint}", f"output={output}", "format=onnx"]
    _export(monkeypatch, *typed, "image_size=[32,48]")
    assert "4 channels, 32×48; scores" in capsys.readouterr().out
    assert load_trained(output).fixed_size == (32, 48)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "checkpoint: found none; .* For example: tangent-export checkpoint="),
        (["checkpoint={}"], r"output: found none; expected a file ending in \.onnx, \.safetensors"),
        (["checkpoint={}", "output=x.bin"], r"output: found x\.bin; expected a name ending in"),
        (["checkpoint={}", "output=x.pt", "format=onnx"], r"output: found x\.pt; .* \.onnx"),
        (["checkpoint={}", "output=x.pt"], r"output: found x\.pt; .* \.onnx, \.safetensors\.$"),
        (["checkpoint={}", "output=x.pt", "format=torchscript"], "format: found torchscript; exp"),
        (["checkpoint={}", "output=x.onnx", "format=tf"], "format: found tf; expected onnx or"),
        (["checkpoint={}", "output=x.onnx", "image_size=32"], "image_size: found 32; expected"),
        (["checkpoint={}", "output=x.onnx", "image_size=[1,a]"], r"image_size: .*height, width"),
        (["checkpoint={}", "output=x.onnx", "image_size=[15,16]"], "image_size: .* multiples of 2"),
        (["checkpoint={}", "output=x.onnx", "opset=new"], "opset: found new; expected a whole"),
        (["checkpoint=none.ckpt", "output=x.onnx"], r"none\.ckpt: found no such file"),
        (["checkpoints=x"], "unknown setting: found 'checkpoints'; .*Did you mean checkpoint"),
    ],
)
def test_what_is_wrong_is_said(
    arguments: list[str],
    message: str,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=f"^tangent-export: {message}"):
        _export(monkeypatch, *(text.format(checkpoint) for text in arguments))
    assert list(tmp_path.iterdir()) == []


def test_what_does_not_compute_the_same_is_no_success(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(path: Path, trust: set[str]) -> object:
        found = load_trained(path, trust)
        torch.nn.init.zeros_(found.network.network.head.weight)  # type: ignore[union-attr, arg-type]
        return found

    monkeypatch.setattr(export_module, "load_trained", other)
    with pytest.raises(SystemExit, match="scores that differ by"):
        _export(monkeypatch, f"checkpoint={checkpoint}", f"output={tmp_path}/model.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_page_from_top_to_bottom(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What other programs make of the files is what this one computes."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / PAGE).read_text()
    for name, content in shown_files(text).items():
        (tmp_path / name).write_text(content)
    rgb, depth_mm = _write_panorama(tmp_path)
    ran = set()
    for command in commands(PAGE, text):
        program, *arguments = command.words
        if program == "pip" or program == "tangent-predict":
            continue
        typed = [
            f"checkpoint={checkpoint}" if a.startswith("checkpoint=runs/") else a for a in arguments
        ]
        monkeypatch.setattr(sys, "argv", [program, *typed])
        if program == "python":
            runpy.run_path(typed[0], run_name="__main__")
        else:
            getattr(main, program.removeprefix("tangent-"))()
        ran.add(program)
    assert ran == {"tangent-export", "tangent-render", "python"}
    labels = np.asarray(Image.open("labels.png"))
    assert labels.shape == rgb.shape[:2]
    expected = _labels(checkpoint, rgb, depth_mm)
    assert (labels == expected).mean() > 0.99
    assert np.bincount(expected.ravel()).max() < 0.9 * expected.size  # several classes


def _write_panorama(folder: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Smooth colours and depths with a part that is missing, as the page's files."""
    rng = np.random.default_rng(3)
    rgb = cv2.resize(rng.integers(0, 256, (8, 16, 3), np.uint8), (256, 128))
    depth_mm = cv2.resize(rng.integers(0, 6000, (8, 16), np.uint16), (256, 128))
    depth_mm[40:60, 100:140] = 0
    Image.fromarray(rgb).save(folder / "panorama.jpg", quality=100, subsampling=0)
    (folder / "depth").mkdir()
    Image.fromarray(depth_mm).save(folder / "depth" / "panorama.png")
    return np.asarray(Image.open(folder / "panorama.jpg")), depth_mm


def _labels(
    checkpoint: Path, rgb: NDArray[np.uint8], depth_mm: NDArray[np.uint16]
) -> NDArray[np.int64]:
    """By PyTorch and this package's own renderers, labels of the nearest pixel of the owner."""
    from tangent_train.geometry import TangentGrid
    from tangent_train.rendering import equirect_to_tangent

    grid = TangentGrid(0, 6, 48)
    depth_m = (depth_mm / 1000).astype(np.float32).clip(0, 4)
    color = equirect_to_tangent(rgb, grid).astype(np.float32) / 255
    depth = equirect_to_tangent(depth_m, grid, interpolation="nearest")
    trained = load_trained(checkpoint)
    mean, std = np.array(trained.normalization.mean), np.array(trained.normalization.std)
    images = (np.concatenate([color, depth[..., None]], axis=-1) - mean) / std
    with torch.no_grad():
        scores = trained.network(torch.tensor(images, dtype=torch.float32).movedim(-1, 1))
    labels = 1 + scores[:, 1:].argmax(dim=1).numpy()
    rows, columns = rgb.shape[:2]
    latitude = np.pi / 2 - (np.arange(rows) + 0.5) / rows * np.pi
    longitude = (np.arange(columns) + 0.5) / columns * 2 * np.pi - np.pi
    phi, lam = np.meshgrid(latitude, longitude, indexing="ij")
    xyz = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], axis=-1)
    owner = (xyz @ grid.centers_xyz.T).argmax(axis=-1)
    seen = np.einsum("hwji,hwj->hwi", grid.world_from_camera[owner], xyz)
    pixel = seen @ grid.camera_matrix.T
    column, row = (np.rint(pixel[..., i] / pixel[..., 2]).astype(int) for i in (0, 1))
    found: NDArray[np.int64] = labels[owner, row, column]
    return found
