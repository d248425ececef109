"""Photo networks as checkpoints, through `tangent-import`."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from onnx import helper
from torchvision import models as torchvision_models

import tangent_train as tt
from models import UNet
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import (
    ViewSelector,
)
from tests.cli.tiny_runs import Predict, Run
from tests.models.onnx_files import write_linear
from tests.running import Capture
from tests.tasks.small_networks import with_statistics

NAMES = ["background", "dark", "green", "bright"]
WEIGHT = np.array([[0, 0, 0], [-1, -1, -1], [-1, 2, -1], [1, 1, 1]], np.float32)
BIAS = np.array([0.1, 1, 0, -1.5], np.float32)


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """The current folder of commands, with a network and the names of its scores."""
    write_linear(tmp_path / "net.onnx", WEIGHT, BIAS, shape=("n", 3, 32, 32))
    (tmp_path / "classes.json").write_text(json.dumps(NAMES))
    return tmp_path


TORCHVISION = ("library=torchvision", "output=net.ckpt")
OF_ONNX = ("library=onnx", "file=net.onnx", "classes=classes.json", "normalization=unit")


@pytest.mark.parametrize("wins", [True, False])
def test_an_onnx_file_labels_panoramas(wins: bool, here: Path, run: Run, capsys: Capture) -> None:
    """Blocks of one color: the labels are those of every pixel's own scores."""
    unknown = ("unknown_classes=[background]", f"unknown_wins={wins}".lower())
    run("import", *OF_ONNX, *unknown, "fov=90", "output=ours.onnx")
    printed = capsys.readouterr().out
    assert "3 classes: dark, green, bright\n" in printed
    assert f"background: {'written as unknown' if wins else 'never win'}" in printed
    trained = load_network(here / "ours.onnx")
    assert trained.class_names == ("unknown", "dark", "green", "bright")
    assert (trained.fixed_size, trained.level) == ((32, 32), 5)
    colors = np.array([[0, 0, 0], [0, 255, 0], [255, 255, 255], [110, 90, 110]], np.uint8)
    rgb = colors[np.arange(8) % 4].repeat(16, axis=0)[None].repeat(64, axis=0)
    scores = Predictor(trained, head_of(trained), ViewSelector(trained, levels=(7,))).predict(
        InputImage(rgb)
    )
    labels = scores.pixels()
    scores_by_hand = rgb / 255 @ WEIGHT.T + BIAS
    expected = (
        scores_by_hand.argmax(axis=-1) if wins else scores_by_hand[..., 1:].argmax(axis=-1) + 1
    )
    middle = np.arange(128).reshape(8, 16)[:, 6:10].ravel()  # away from the edges of the blocks
    np.testing.assert_array_equal(labels[16:48][:, middle], expected[16:48][:, middle])
    assert set(np.unique(expected)) == ({0, 1, 2, 3} if wins else {1, 2, 3})


def test_weights_beside_an_onnx_file_are_written_into_it(here: Path, run: Run) -> None:
    """The default of `torch.onnx.export`: larger tensors are in ``net.onnx.data``."""
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 64, 3, padding=1), torch.nn.Conv2d(64, 4, 1))
    images = torch.rand(1, 3, 32, 32)
    torch.onnx.export(network.eval(), (images,), here / "net.onnx", dynamo=True, verbose=False)
    assert (here / "net.onnx.data").stat().st_size > 3 * 64 * 9 * 4
    run("import", *OF_ONNX, "output=ours.onnx")
    (here / "net.onnx.data").unlink()
    with torch.no_grad():
        expected = network(images)
    torch.testing.assert_close(load_network(here / "ours.onnx").network(images), expected)
    with pytest.raises(SystemExit, match=r"net\.onnx\.data.*; expected an ONNX file"):
        run("import", *OF_ONNX, "output=other.onnx")


@pytest.mark.parametrize("size", [(48, 96), (50, 20)])
def test_a_file_for_images_that_are_not_square(
    size: tuple[int, int], here: Path, run: Run, capsys: Capture
) -> None:
    """Larger images are divided into tiles: labels are those of every pixel's own scores."""
    write_linear(here / "net.onnx", WEIGHT, BIAS, shape=(1, 3, *size))
    run("import", *OF_ONNX, "output=ours.onnx")
    assert f"image size: {size[1]} × {size[0]} (width × height)\n" in capsys.readouterr().out
    trained = load_network(here / "ours.onnx")
    assert trained.fixed_size == size
    assert trained.image_size == (max(size), max(size))
    with pytest.raises(SystemExit, match="for an RGB image of 65 × 64"):
        run("import", *OF_ONNX, "output=other.onnx", "image_size=[64,65]")
    colors = np.array([[0, 0, 0], [0, 255, 0], [255, 255, 255]], np.uint8)
    rgb = colors[[0, 1, 2, 1]].repeat(32, axis=0)[None].repeat(64, axis=0)
    mosaic = Predictor(trained, head_of(trained), ViewSelector(trained)).predict(InputImage(rgb))
    labels = mosaic.pixels()
    expected = (rgb / 255 @ WEIGHT.T + BIAS).argmax(axis=-1) + 1
    middle = np.arange(128).reshape(4, 32)[:, 10:22].ravel()  # away from the edges of the blocks
    np.testing.assert_array_equal(labels[16:48][:, middle], expected[16:48][:, middle])


def test_a_network_of_a_config_and_its_export_compute_the_same(here: Path, run: Run) -> None:
    torch.manual_seed(0)
    network = UNet(3, 4, (16, 32, 64, 128, 256)).eval()
    torch.save(network.state_dict(), here / "state.pt")
    given = ("weights=state.pt", "classes=classes.json", "normalization=imagenet")
    size = ("levels=6", "base_level=1", "unknown_classes=[background]")
    run("import", "network=unet_small", *given, *size, "output=net.ckpt")
    trained = load_network(here / "net.ckpt")
    assert trained.normalization.mean == (0.485, 0.456, 0.406)
    images = torch.randn(2, 3, 32, 48)
    with torch.no_grad():
        expected = network(images)[:, [1, 2, 3, 0]]
        torch.testing.assert_close(trained.network(images), expected)
        run("export", "checkpoint=net.ckpt", "output=again.safetensors")
        again = load_network(here / "again.safetensors")
        assert again.class_names == trained.class_names
        torch.testing.assert_close(again.network(images), expected)


def test_a_network_of_ones_own_is_imported(here: Path, run: Run, capsys: Capture) -> None:
    (here / "own" / "network").mkdir(parents=True)
    (here / "own" / "network" / "mine.yaml").write_text(
        "_target_: tests.tasks.small_networks.with_statistics\nnetwork:\n  _target_: models.UNet\n"
        "  in_channels: null\n  num_classes: null\n  widths: [4, 8]\n"
    )
    network = with_statistics(UNet(3, 4, (4, 8)))
    torch.save(network.state_dict(), here / "state.pt")
    given = ("weights=state.pt", "classes=classes.json", "normalization=unit", "output=net.ckpt")
    run("import", "--config-dir", "own", "network=mine", *given)
    scores_by_hand = "tests.tasks.small_networks.with_statistics"
    assert f"trust=[{scores_by_hand}]" in capsys.readouterr().out
    assert load_network(here / "net.ckpt", [scores_by_hand]).class_names == ("unknown", *NAMES)
    with pytest.raises(DataError, match=f"trust={scores_by_hand}"):
        load_network(here / "net.ckpt")


def test_torchvision_gives_the_scores_of_its_own_transform(
    here: Path, run: Run, capsys: Capture
) -> None:
    torch.manual_seed(0)
    name = "lraspp_mobilenet_v3_large"
    network = torchvision_models.get_model(name, weights=None, weights_backbone=None).eval()
    torch.save(network.state_dict(), here / "state.pt")
    (here / "classes.json").unlink()
    arguments = ("library=torchvision", f"model={name}", "weights=state.pt")
    run("import", *arguments, "output=net.ckpt")
    weights = torchvision_models.get_model_weights(name)["DEFAULT"]
    assert f"21 classes: {', '.join(weights.meta['categories'])}\n" in capsys.readouterr().out
    trained = load_network(here / "net.ckpt")
    assert (trained.image_size, trained.level) == ((520, 520), 9)
    photo = torch.randint(0, 256, (3, 520, 520), dtype=torch.uint8)
    mean, std = (torch.tensor(v)[:, None, None] for v in vars(trained.normalization).values())
    with torch.no_grad():
        expected = network(weights.transforms()(photo)[None])["out"]
        found = trained.network(((photo / 255 - mean) / std)[None])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


# Depth.

OF_DEPTH = (
    *("library=onnx", "file=depth.onnx", "normalization=unit", "output=ours.onnx"),
    "depth=metric_z",
)


def test_an_onnx_file_predicts_depth(
    here: Path, run: Run, predict: Predict, capsys: Capture
) -> None:
    """Its output is ``(B, h, w)``; predictions are resumed."""
    after, axes = helper.make_node("Squeeze", ["linear", "axes"], ["scores"]), np.array([1])
    write_linear(here / "depth.onnx", WEIGHT[3:], np.ones(1, np.float32), after, axes=axes)
    run("import", *OF_DEPTH, "image_size=32")
    printed = capsys.readouterr().out
    assert "MB\nthe network returns metric_z\n" in printed
    assert "panoramas: 16 views of 32 × 32 (130° wide" in printed
    assert printed.splitlines()[-1].startswith("panoramas"), "no remarks"
    trained = load_network(here / "ours.onnx")
    found = trained.depth_kind, trained.predicts, trained.class_names
    assert found == ("metric_z", "distance", ())
    images = torch.rand(2, 3, 32, 32)
    torch.testing.assert_close(trained.network(images), 1 + images.sum(1, keepdim=True))
    rgb = _write_room()
    settings = {"checkpoint": "ours.onnx", "input": "room.png", "depth_format": "npy", "report": 0}
    predict(**settings, write="[depth]")
    np.testing.assert_array_equal(np.load("out/depth/room.npy"), tt.load("ours.onnx").depth(rgb))
    predict(**settings, write="[depth]")
    assert "1 image, 1 done already" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((*OF_DEPTH, "unknown_classes=[sky]"), "unknown_classes: found .*nothing reads it"),
        ((*OF_ONNX, "output=o.onnx", "depth=metric_z"), "classes: found .*nothing reads it"),
        (
            ("library=onnx", "file=net.onnx", *OF_DEPTH[2:]),
            r"found \(1, 4, 32, 32\).*depth with K = 1",
        ),
    ],
)
def test_settings_of_depth_and_of_classes_exclude_each_other(
    given: tuple[str, ...], message: str, here: Path, run: Run
) -> None:
    write_linear(here / "depth.onnx", WEIGHT[3:], np.ones(1, np.float32))
    with pytest.raises(SystemExit, match=message):
        run("import", *given)


# Default views.


def _angles_deg(trained: LoadedNetwork) -> list[int]:
    """Width of the views of each level."""
    section = trained.representation
    grids = [TangentGrid(section["base_level"], n, section["dim"]) for n in section["levels"]]
    return [round(math.degrees(2 * math.atan(grid.dim / 2 * grid.pitch))) for grid in grids]


@pytest.mark.parametrize(
    ("size", "levels", "side", "angles_deg"),
    [
        ((512, 1024), [10, 9], 1024, [96, 131]),
        ((480, 640), [9, 8], 640, [108, 140]),
    ],
)
def test_an_onnx_file_of_any_size_gets_wide_views(
    size: tuple[int, int],
    levels: list[int],
    side: int,
    angles_deg: list[int],
    here: Path,
    run: Run,
    capsys: Capture,
) -> None:
    """With the longer side of its images: horizontal views, or tangent images of two levels."""
    write_linear(here / "net.onnx", WEIGHT, BIAS, shape=(1, 3, *size))
    run("import", *OF_ONNX, "output=ours.onnx")
    assert f"panoramas: 16 views of {side} × {side} (130° wide" in capsys.readouterr().out
    assert load_network(here / "ours.onnx").level == levels[0]
    run("import", *OF_ONNX, "output=tangent.onnx", "views=tangent")
    trained = load_network(here / "tangent.onnx")
    section = trained.representation
    assert (section["base_level"], section["levels"], section["dim"]) == (0, levels, side)
    assert trained.level == levels[0]
    assert _angles_deg(trained) == angles_deg
    text = capsys.readouterr().out
    assert f"panoramas: 40 views of {side} × {side} ({angles_deg[0]}° wide" in text


def _write_room() -> NDArray[np.uint8]:
    """Blurred noise of high contrast, in room.png."""
    rgb = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    rgb = cv2.GaussianBlur(rgb, (0, 0), 3)
    rgb = ((rgb.astype(np.float32) - 127) * 6 + 127).clip(0, 255).astype(np.uint8)
    cv2.imwrite("room.png", rgb[..., ::-1])
    return rgb


def test_level_views_of_an_import(here: Path, run: Run, predict: Predict, capsys: Capture) -> None:
    """Stored by the import, or chosen later: in a command and in Python, with the same labels."""
    run("import", *OF_ONNX, "output=plain.onnx")
    run("import", *OF_ONNX, "output=level.onnx", "views=horizontal_economy")
    assert "panoramas: 12 views of 32 × 32 (130° wide, 0.1 pixels" in capsys.readouterr().out
    trained = load_network(here / "level.onnx")
    assert (trained.level, trained.photo_side, trained.image_size) == (5, 32, (32, 32))
    assert trained.representation["dim"] == 32
    rgb = _write_room()
    expected = tt.load("level.onnx").labels(rgb)
    predict(checkpoint="plain.onnx", input="room.png", output="out", views="horizontal_economy")
    assert "predicted in 12 views of 32 × 32" in capsys.readouterr().out
    found = cv2.imread("out/labels/room.png", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(
        tt.load("plain.onnx", views="horizontal_economy").labels(rgb), expected
    )
    assert (tt.load("level.onnx", views="tangent").labels(rgb) != expected).any()
    level, plain = (
        tt.load(name, views="tangent").labels(rgb) for name in ("level.onnx", "plain.onnx")
    )
    np.testing.assert_array_equal(level, plain)
    sizes = {
        "horizontal": (18, (32, 32)),
        "erp": (1, (32, 64)),
        "cubemap": (6, (32, 32)),
        "tangent": (40, (32, 32)),
        "tangent_economy_16": (40, (32, 32)),
    }
    for option, (count, size) in sizes.items():
        views = ViewSelector(load_network(here / "plain.onnx"), views=option)
        seen = views.representation
        assert (sum(map(len, seen.view_sets())), seen.image_size) == (count, size)
    twice = ViewSelector(trained, rotations=2, views={"option": "horizontal", "fov": [110, 100]})
    assert twice.description().startswith("36 views of 32 × 32 (110° wide")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("classes=null",), "classes: found none; .*For a depth network, set depth= to one of log"),
        (
            ("classes=three.json",),
            "class names .*: found 3, .*expected names of 4 scores",
        ),
        (("normalization=null",), "normalization: found none; expected imagenet, unit, symmetric"),
        (
            ("unknown_classes=[sky]",),
            "unknown_classes sky; expected unknown_classes among background",
        ),
        (
            ("output=ours.ckpt",),
            r"output: found ours\.ckpt; expected .*\.onnx\. An ONNX network stays",
        ),
        (
            (*TORCHVISION, "model=lraspp_mobilenet_v3_large", "weights=VOC"),
            "weights: found 'VOC'; expected 'COCO_WITH_VOC_LABELS_V1'",
        ),
    ],
)
def test_unusable_files_are_one_clear_message(
    changes: tuple[str, ...], message: str, here: Path, run: Run
) -> None:
    (here / "three.json").write_text(json.dumps(NAMES[1:]))
    before = set(here.iterdir())
    with pytest.raises(SystemExit, match=message):
        run("import", *(() if changes[0] in TORCHVISION else OF_ONNX), "output=ours.onnx", *changes)
    assert set(here.iterdir()) == before
