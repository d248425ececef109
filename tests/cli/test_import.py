"""Photo networks as checkpoints, through `tangent-import`."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torchvision import models as torchvision_models

from models import UNet
from tangent_train.checkpoints.trained import load_trained
from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid, camera_matrix_from_fov
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.photo_networks.importing import representation_of
from tangent_train.inference.representations import PanoramaViews
from tests.cli.tiny_runs import Run
from tests.models.onnx_files import write_linear
from tests.running import Capture, Patch
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


TORCHVISION = ("network=torchvision", "output=net.ckpt")
OF_ONNX = ("network=onnx", "file=net.onnx", "classes=classes.json", "normalization=unit")


@pytest.mark.parametrize("wins", [True, False])
def test_an_onnx_file_labels_panoramas(wins: bool, here: Path, run: Run, capsys: Capture) -> None:
    """Blocks of one color: the labels are those of every pixel's own scores."""
    unknown = ("unknown_classes=[background]", f"unknown_wins={wins}".lower())
    run("import", *OF_ONNX, *unknown, "fov=90", "output=ours.onnx")
    printed = capsys.readouterr().out
    assert "3 classes: dark, green, bright\n" in printed
    assert f"background: {'written as unknown' if wins else 'never win'}" in printed
    trained = load_trained(here / "ours.onnx")
    assert trained.class_names == ("unknown", "dark", "green", "bright")
    assert (trained.fixed_size, trained.level) == ((32, 32), 5)
    colors = np.array([[0, 0, 0], [0, 255, 0], [255, 255, 255], [110, 90, 110]], np.uint8)
    rgb = colors[np.arange(8) % 4].repeat(16, axis=0)[None].repeat(64, axis=0)
    scores = Predictor(trained, PanoramaViews(trained, levels=(7,))).predict(InputImage(rgb))
    labels = trained.labels(scores.labels())
    scores_by_hand = rgb / 255 @ WEIGHT.T + BIAS
    expected = (
        scores_by_hand.argmax(axis=-1) if wins else scores_by_hand[..., 1:].argmax(axis=-1) + 1
    )
    middle = np.arange(128).reshape(8, 16)[:, 6:10].ravel()  # away from the edges of the blocks
    np.testing.assert_array_equal(labels[16:48][:, middle], expected[16:48][:, middle])
    assert set(np.unique(expected)) == ({0, 1, 2, 3} if wins else {1, 2, 3})


@pytest.mark.parametrize("size", [(48, 96), (96, 48), (32, 64), (20, 50)])
def test_a_file_for_images_that_are_not_square(
    size: tuple[int, int], here: Path, run: Run, capsys: Capture
) -> None:
    """Larger images are divided into tiles: labels are those of every pixel's own scores."""
    write_linear(here / "net.onnx", WEIGHT, BIAS, shape=(1, 3, *size))
    run("import", *OF_ONNX, "output=ours.onnx")
    assert f"image size: {size[1]} × {size[0]} (width × height)\n" in capsys.readouterr().out
    trained = load_trained(here / "ours.onnx")
    assert trained.fixed_size == size
    assert trained.image_size == (max(size), max(size))
    with pytest.raises(SystemExit, match=f"found 65 × 64 .*expected {size[1]} × {size[0]} .*the"):
        run("import", *OF_ONNX, "output=other.onnx", "image_size=[64,65]")
    colors = np.array([[0, 0, 0], [0, 255, 0], [255, 255, 255]], np.uint8)
    rgb = colors[[0, 1, 2, 1]].repeat(32, axis=0)[None].repeat(64, axis=0)
    mosaic = Predictor(trained, PanoramaViews(trained)).predict(InputImage(rgb))
    labels = trained.labels(mosaic.labels())
    expected = (rgb / 255 @ WEIGHT.T + BIAS).argmax(axis=-1) + 1
    middle = np.arange(128).reshape(4, 32)[:, 10:22].ravel()  # away from the edges of the blocks
    np.testing.assert_array_equal(labels[16:48][:, middle], expected[16:48][:, middle])


def test_any_network_is_given_one_size_if_asked(here: Path, run: Run) -> None:
    torch.manual_seed(0)
    network = UNet(3, 4, (16, 32, 64, 128, 256)).eval()
    torch.save({"model": {f"module.{n}": t for n, t in network.state_dict().items()}}, "state.pt")
    given = ("network=unet_small", "weights=state.pt", "classes=classes.json", "normalization=unit")
    run("import", *given, "image_size=[32,64]", "output=net.ckpt")
    trained = load_trained(here / "net.ckpt")
    assert (trained.fixed_size, trained.image_size) == ((32, 64), (64, 64))
    for wrong in ("image_size=0", "image_size=[32,64,3]"):
        with pytest.raises(SystemExit, match=r"size: found .*; expected \[rows,columns\], or"):
            run("import", *given, wrong, "output=other.ckpt")


def test_published_weights_without_internet(here: Path, run: Run, monkeypatch: Patch) -> None:
    """The remedy works: the file, fetched elsewhere, where torch looks for it."""
    name = "lraspp_mobilenet_v3_large"
    monkeypatch.setenv("TORCH_HOME", str(here / "torch"))
    monkeypatch.setattr(torch.hub, "download_url_to_file", _no_internet)
    given = ("network=torchvision", f"model={name}", "weights=DEFAULT", "output=net.ckpt")
    with pytest.raises(SystemExit, match="Fetch it on another machine and save it as") as message:
        run("import", *given)
    file = Path(str(message.value).rpartition("save it as ")[2].removesuffix("."))
    network = torchvision_models.get_model(name, weights=None, weights_backbone=None)
    file.parent.mkdir(parents=True, exist_ok=True)
    torch.save(network.state_dict(), file)
    run("import", *given)
    assert load_trained(here / "net.ckpt").class_names[1] == "__background__"


def _no_internet(*_: object, **__: object) -> None:
    raise OSError("no route to host")


def test_a_network_of_a_config_and_its_export_compute_the_same(here: Path, run: Run) -> None:
    torch.manual_seed(0)
    network = UNet(3, 4, (16, 32, 64, 128, 256)).eval()
    torch.save(network.state_dict(), here / "state.pt")
    given = ("weights=state.pt", "classes=classes.json", "normalization=imagenet")
    size = ("level=6", "base_level=1", "unknown_classes=[background]")
    run("import", "network=unet_small", *given, *size, "output=net.ckpt")
    trained = load_trained(here / "net.ckpt")
    assert trained.normalization.mean == (0.485, 0.456, 0.406)
    images = torch.randn(2, 3, 32, 48)
    with torch.no_grad():
        expected = network(images)[:, [1, 2, 3, 0]]
        torch.testing.assert_close(trained.network(images), expected)
        run("export", "checkpoint=net.ckpt", "output=again.safetensors")
        again = load_trained(here / "again.safetensors")
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
    assert load_trained(here / "net.ckpt", [scores_by_hand]).class_names == ("unknown", *NAMES)
    with pytest.raises(DataError, match=f"trust={scores_by_hand}"):
        load_trained(here / "net.ckpt")


def test_torchvision_gives_the_scores_of_its_own_transform(
    here: Path, run: Run, capsys: Capture
) -> None:
    torch.manual_seed(0)
    name = "lraspp_mobilenet_v3_large"
    network = torchvision_models.get_model(name, weights=None, weights_backbone=None).eval()
    torch.save(network.state_dict(), here / "state.pt")
    (here / "classes.json").unlink()
    arguments = ("network=torchvision", f"model={name}", "weights=state.pt")
    run("import", *arguments, "output=net.ckpt")
    weights = torchvision_models.get_model_weights(name)["DEFAULT"]
    assert f"21 classes: {', '.join(weights.meta['categories'])}\n" in capsys.readouterr().out
    trained = load_trained(here / "net.ckpt")
    photo = torch.randint(0, 256, (3, 520, 520), dtype=torch.uint8)
    mean, std = (torch.tensor(v)[:, None, None] for v in vars(trained.normalization).values())
    with torch.no_grad():
        expected = network(weights.transforms()(photo)[None])["out"]
        found = trained.network(((photo / 255 - mean) / std)[None])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("size", "fov", "expected"),
    [
        ((512, 512), 60.0, (1, 10, 512)),
        ((384, 384), 60.0, (2, 10, 384)),
        ((512, 1024), 60.0, (2, 11, 512)),
        ((128, 128), 45.0, (1, 8, 128)),
    ],
)
def test_tangent_images_have_the_angular_resolution_of_the_photos(
    size: tuple[int, int], fov: float, expected: tuple[int, int, int]
) -> None:
    _, *found = representation_of(size, fov).values()
    assert tuple(found) == expected
    grid = TangentGrid(*expected)
    focal = camera_matrix_from_fov(fov, size)[0, 0]
    assert abs(math.log2(1 / grid.pitch / focal)) < 0.6, "within half a level, and the base level's"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("classes=three.json",), "^tangent-import: class names .*: found 3, for 4 scores; exp"),
        (("classes=holes.json",), r"holes\.json: found .*; expected a JSON list"),
        (("classes=escapes.json",), r"escapes\.json: found .*; expected a JSON list"),
        (("normalization=null",), "normalization: found none; expected imagenet, unit, symmetric"),
        (
            ("unknown_classes=[sky]",),
            "unknown_classes: found sky; expected names among background, dark",
        ),
        (("unknown_classes=[background,dark,green,bright]",), "unknown_classes: found all classes"),
        (("scores=softmax",), "scores: found softmax; expected"),
        (("output=ours.ckpt",), r"output: found ours\.ckpt; expected .*\.onnx"),
        ((*TORCHVISION, "model=resnet50"), "model: found resnet50; expected deeplabv3"),
        (
            (*TORCHVISION, "model=lraspp_mobilenet_v3_large", "weights=VOC"),
            "weights: found VOC; expected COCO_WITH_VOC_LABELS_V1, DEFAULT, or a file",
        ),
    ],
)
def test_unusable_files_are_one_clear_message(
    changes: tuple[str, ...], message: str, here: Path, run: Run
) -> None:
    (here / "three.json").write_text(json.dumps(NAMES[1:]))
    (here / "holes.json").write_text(json.dumps({"0": "wall", "2": "floor"}))
    (here / "escapes.json").write_text(json.dumps([*NAMES[1:], "a\x1b[2J"]))
    before = set(here.iterdir())
    with pytest.raises(SystemExit, match=message):
        run("import", *OF_ONNX, "output=ours.onnx", *changes)
    assert set(here.iterdir()) == before


def test_classes_by_place_and_the_kind_of_scores(here: Path, run: Run) -> None:
    (here / "classes.json").write_text(json.dumps({"3": "d", "0": "a", "1": "b", "2": "c"}))
    run("import", *OF_ONNX, "output=ours.onnx", "scores=sigmoid_logits")
    trained = load_trained(here / "ours.onnx")
    assert trained.class_names == ("unknown", "a", "b", "c", "d")
    assert (trained.score_kind, trained.groups) == ("sigmoid_logits", [[0], [1], [2], [3], [4]])
