"""Labels and scores of arrays and tensors: those of `tangent-predict`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import tangent_train as tt
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.network import Network
from tests.cli.tiny_runs import run_command
from tests.inference.trained import CUBE, PERSPECTIVE, TANGENT, sphere, write_checkpoint

Predicted = Callable[..., tuple[NDArray[Any], NDArray[Any]]]


@pytest.fixture
def predicted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Predicted:
    """Labels and probabilities that `tangent-predict` writes of an image, with ``net.ckpt``."""

    def run(rgb: NDArray[np.uint8], *typed: str) -> tuple[NDArray[Any], NDArray[Any]]:
        monkeypatch.chdir(tmp_path)
        cv2.imwrite("room.png", rgb[..., ::-1])
        given = ["checkpoint=net.ckpt", "input=room.png", "output=out"]
        given += ["write=[labels,probabilities]"]
        run_command(monkeypatch, "predict", *given, "report=0", *typed)
        labels: Any = cv2.imread("out/labels/room.png", cv2.IMREAD_UNCHANGED)
        return labels, np.load("out/probabilities/room.npy")

    return run


@pytest.fixture
def network(tmp_path: Path) -> Network:
    return tt.load(write_checkpoint(tmp_path / "net.ckpt"))


@pytest.mark.parametrize(
    ("representation", "fov", "typed", "settings"),
    [
        (TANGENT, None, [], {}),
        (TANGENT, None, ["levels=[4,5]", "rotations=2"], {"levels": (4, 5), "rotations": 2}),
        (CUBE, None, ["blend=nearest", "base_level=1"], {"blend": "nearest", "base_level": 1}),
        (PERSPECTIVE, None, ["level=5"], {"level": 5}),
        (TANGENT, None, ["min_confidence=0.6"], {"min_confidence": 0.6}),
        (TANGENT, 120.5, ["level=5", "blend=nearest"], {"level": 5, "blend": "nearest"}),
        (TANGENT, 65, ["base_level=1"], {"base_level": 1}),
    ],
)
def test_panoramas_and_photos_get_the_labels_and_scores_of_tangent_predict(
    tmp_path: Path,
    predicted: Predicted,
    representation: dict[str, Any],
    fov: float | None,
    typed: list[str],
    settings: dict[str, Any],
) -> None:
    network = tt.load(write_checkpoint(tmp_path / "net.ckpt", representation), **settings)
    image = sphere(50) if fov is None else sphere(40)[:, :57]
    of_photo = [] if fov is None else [f"fov={fov}", "projection=perspective"]
    expected, probabilities = predicted(image, *of_photo, *typed)
    labels = network.labels(image, fov=fov)
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, expected)
    if fov is None:
        assert len(np.unique(labels)) == 3 + ("min_confidence" in settings)  # unknown
    scores = network.scores(image, fov=fov)
    assert scores.dtype == np.float32
    np.testing.assert_allclose(scores, probabilities, atol=1e-3)
    np.testing.assert_allclose(scores.sum(axis=-1), 1, atol=1e-5)


def test_tensors_get_what_arrays_get(network: Network) -> None:
    panorama = sphere(33)
    tensor = torch.from_numpy(panorama).permute(2, 0, 1)
    labels, scores = network.labels(tensor), network.scores(tensor)
    assert (labels.dtype, labels.shape) == (torch.int64, (33, 66))
    assert (scores.dtype, scores.shape) == (torch.float32, (3, 33, 66))
    np.testing.assert_array_equal(labels.numpy(), network.labels(panorama))
    np.testing.assert_array_equal(scores.movedim(0, -1).numpy(), network.scores(panorama))
    photo = tensor[:, :20, :30]
    expected = network.labels(panorama[:20, :30], fov=60)
    np.testing.assert_array_equal(network.labels(photo, fov=60).numpy(), expected)


@pytest.mark.gpu
def test_a_gpu_gives_what_the_cpu_gives(tmp_path: Path, network: Network) -> None:
    panorama = torch.from_numpy(sphere(33)).permute(2, 0, 1)
    on_gpu = tt.load(tmp_path / "net.ckpt", device="cuda").labels(panorama.cuda())
    assert on_gpu.is_cuda
    assert (on_gpu.cpu() == network.labels(panorama)).double().mean() > 0.99


def test_no_more_images_than_asked_for_are_in_memory(tmp_path: Path) -> None:
    network = tt.load(write_checkpoint(tmp_path / "net.ckpt"), images_per_forward=7)
    counts: list[int] = []
    network.trained.network.register_forward_pre_hook(
        lambda _, images: counts.append(len(images[0]))
    )
    network.labels(sphere(32))
    assert counts == [7, 7, 6]


def test_depth_is_in_metres(tmp_path: Path, predicted: Predicted) -> None:
    """Missing where 0 or NaN; in 16-bit files of 1/512 m it is exactly the same."""
    network = tt.load(write_checkpoint(tmp_path / "net.ckpt", TANGENT, channels=4))
    panorama = sphere(32)
    steps = np.random.default_rng(0).integers(0, 2000, (32, 64), np.uint16)
    depth_m = steps / 512
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth" / "room.png"), steps)
    expected, _ = predicted(panorama, "depth=depth", "depth_scale=512")
    np.testing.assert_array_equal(network.labels(panorama, depth=depth_m), expected)
    depth_m[depth_m == 0] = np.nan
    tensors = torch.from_numpy(panorama).permute(2, 0, 1), torch.from_numpy(depth_m)
    np.testing.assert_array_equal(network.labels(tensors[0], depth=tensors[1]), expected)
    assert (network.labels(panorama, depth=depth_m * 0) != expected).any()
    for wrong in (None, depth_m[:16], steps):
        with pytest.raises(
            SettingError, match=r"depth: .*expected floats in metres, 64 × 32 \(width × height\)"
        ):
            network.labels(panorama, depth=wrong)


@pytest.mark.parametrize("unmapped", ["unknown", "never"])
def test_classes_of_another_data_set(tmp_path: Path, predicted: Predicted, unmapped: Any) -> None:
    checkpoint = write_checkpoint(tmp_path / "net.ckpt")
    (tmp_path / "map.json").write_text('{"classes": {"light": ["bright"], "shade": ["dark"]}}')
    network = tt.load(checkpoint, class_map=tmp_path / "map.json", unmapped=unmapped)
    assert network.class_names == ("unknown", "light", "shade")
    assert len(network.palette) == 3
    expected, probabilities = predicted(sphere(32), "class_map=map.json", f"unmapped={unmapped}")
    labels, scores = network.labels(sphere(32)), network.scores(sphere(32))
    np.testing.assert_array_equal(labels, expected)
    np.testing.assert_allclose(scores, probabilities, atol=1e-3)
    assert (scores.sum(axis=-1).min() < 0.9) == (unmapped == "unknown")
    assert (labels == 0).any() == (unmapped == "unknown")


_RGB = np.zeros((16, 32, 3), np.uint8)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (_RGB[:, :31], r"found 31 × 16 \(width × height\); expected the whole sphere.*fov="),
        (_RGB[..., 0], r"ndarray \(16, 32\) of uint8; expected .* array \(H, W, 3\)"),
        (torch.zeros(16, 32, 3, dtype=torch.uint8), r"found Tensor \(16, 32, 3\).*\(3, H, W\)"),
        (torch.zeros(3, 16, 32), "found Tensor.*float32; expected RGB of 0 to 255"),
        (_RGB[:0, :0], r"\(0, 0, 3\)"),
        ("room.jpg", "found str"),
    ],
)
def test_other_images_are_refused(image: Any, message: str, network: Network) -> None:
    with pytest.raises(SettingError, match=message):
        network.labels(image)


def test_impossible_settings_are_refused(tmp_path: Path, network: Network) -> None:
    with pytest.raises(SettingError, match="None: the network sees rgb"):
        network.labels(_RGB, depth=np.zeros((16, 32)))
    with pytest.raises(SettingError, match="unmapped: found '0'"):
        tt.load(tmp_path / "net.ckpt", unmapped="0")  # type: ignore[arg-type]


def test_a_name_of_trusted_code_is_one_name(tmp_path: Path) -> None:
    content = torch.load(write_checkpoint(tmp_path / "net.ckpt"), weights_only=True)
    content["config"]["network"] = {
        "_target_": "tests.inference.trained.color_network",
        "channels": 3,
    }
    torch.save(content, tmp_path / "net.ckpt")
    with pytest.raises(DataError, match="trust"):
        tt.load(tmp_path / "net.ckpt", trust="the.tests.inference.trained.color_network")
    trusted = tt.load(tmp_path / "net.ckpt", trust="tests.inference.trained.color_network")
    assert trusted.labels(_RGB).shape == (16, 32)
