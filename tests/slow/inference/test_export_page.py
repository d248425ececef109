"""docs/export.md from top to bottom: other programs compute what this one does."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli import main
from tangent_train.geometry import TangentGrid, equirect_directions
from tangent_train.rendering import equirect_to_tangent
from tests.tasks.small_networks import save_checkpoint

PAGE = Path(__file__).parents[3] / "docs" / "export.md"


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "best.ckpt"
    task = save_checkpoint(path, "network.widths=[4,8]")
    content = torch.load(path, weights_only=True)
    with torch.no_grad():  # no class is the best everywhere
        scores = task(torch.randn(4, 4, 32, 32, generator=torch.Generator().manual_seed(0)))
    content["state_dict"]["network.head.bias"] -= scores.mean(dim=(0, 2, 3))
    torch.save(content, path)
    return path


def test_the_page(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    rgb = cv2.resize(rng.integers(0, 256, (8, 16, 3), np.uint8), (256, 128))
    depth_mm = cv2.resize(rng.integers(0, 6000, (8, 16), np.uint16), (256, 128))
    depth_mm[40:60, 100:140] = 0
    Image.fromarray(rgb).save("panorama.jpg", quality=100, subsampling=0)
    Path("depth").mkdir()
    Image.fromarray(depth_mm).save("depth/panorama.png")
    text = PAGE.read_text()
    (script,) = re.findall(r"```python\n# label_faces\.py\n(.*?)```", text, re.DOTALL)
    Path("label_faces.py").write_text(script)
    ran = set()
    for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL):
        for line in block.splitlines():
            program, *arguments = shlex.split(line)
            typed = [f"checkpoint={checkpoint}" if "runs/" in a else a for a in arguments]
            monkeypatch.setattr(sys, "argv", [program, *typed])
            if program == "python":
                runpy.run_path(typed[0], run_name="__main__")
            else:
                getattr(main, program.removeprefix("tangent-"))()
            ran.add(program)
    assert ran == {"tangent-export", "tangent-render", "python"}
    expected = _labels(checkpoint, np.asarray(Image.open("panorama.jpg")), depth_mm)
    assert (np.asarray(Image.open("labels.png")) == expected).mean() > 0.99
    assert np.bincount(expected.ravel()).max() < 0.9 * expected.size  # several classes


def _labels(checkpoint: Path, rgb: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """By PyTorch, the label of the nearest pixel of the image that owns a direction."""
    grid = TangentGrid(0, 6, 48)
    depth_m = (depth_mm / 1000).astype(np.float32).clip(0, 4)
    color = equirect_to_tangent(rgb, grid).astype(np.float32) / 255
    depth = equirect_to_tangent(depth_m, grid, interpolation="nearest")
    trained = load_trained(checkpoint)
    mean, std = np.array(trained.normalization.mean), np.array(trained.normalization.std)
    images = (np.concatenate([color, depth[..., None]], axis=-1) - mean) / std
    with torch.no_grad():
        scores = trained.network(torch.tensor(images, dtype=torch.float32).movedim(-1, 1))
    labels = 1 + scores.argmax(dim=1).numpy()
    xyz = equirect_directions((rgb.shape[0], rgb.shape[1]))
    owner = (xyz @ grid.centers_xyz.T).argmax(axis=-1)
    pixel = np.einsum("hwji,hwj->hwi", grid.world_from_camera[owner], xyz) @ grid.camera_matrix.T
    column, row = (np.rint(pixel[..., i] / pixel[..., 2]).astype(int) for i in (0, 1))
    return np.asarray(labels[owner, row, column])
