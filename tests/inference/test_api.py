"""Labels and scores of arrays and tensors: those of `tangent-predict`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import tangent_train as tt
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.api import Network
from tests.cli.tiny_runs import run_command
from tests.datamodules.data_files import gpano_xmp
from tests.inference.trained import CUBE, TANGENT, sphere, write_checkpoint

Predicted = Callable[..., tuple[NDArray[Any], NDArray[Any]]]


@pytest.fixture
def predicted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Predicted:
    """Labels and probabilities that `tangent-predict` writes of an image, with ``net.ckpt``.

    None for the one that is in the folder.
    """

    def run(rgb: NDArray[np.uint8] | None, *typed: str) -> tuple[NDArray[Any], NDArray[Any]]:
        monkeypatch.chdir(tmp_path)
        if rgb is not None:
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
        (TANGENT, None, ["levels=[4,5]", "rotations=2"], {"levels": (4, 5), "rotations": 2}),
        (CUBE, None, ["blend=nearest", "base_level=1"], {"blend": "nearest", "base_level": 1}),
        (TANGENT, None, ["min_confidence=0.6"], {"min_confidence": 0.6}),
        (TANGENT, 120.5, ["levels=[5,4]", "blend=nearest"], {"levels": (5, 4), "blend": "nearest"}),
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
    scores = network.probabilities(image, fov=fov)
    assert scores.dtype == np.float32
    np.testing.assert_allclose(scores, probabilities, atol=1e-3)
    np.testing.assert_allclose(scores.sum(axis=-1), 1, atol=1e-5)


def test_tensors_get_what_arrays_get(network: Network) -> None:
    panorama = sphere(33)
    tensor = torch.from_numpy(panorama).permute(2, 0, 1)
    labels, scores = network.labels(tensor), network.probabilities(tensor)
    assert (labels.dtype, labels.shape) == (torch.int64, (33, 66))
    assert (scores.dtype, scores.shape) == (torch.float32, (3, 33, 66))
    np.testing.assert_array_equal(labels.numpy(), network.labels(panorama))
    np.testing.assert_array_equal(scores.movedim(0, -1).numpy(), network.probabilities(panorama))
    photo = tensor[:, :20, :30]
    expected = network.labels(panorama[:20, :30], fov=60)
    np.testing.assert_array_equal(network.labels(photo, fov=60).numpy(), expected)


def _write(rgb: NDArray[np.uint8], tags: dict[str, object]) -> None:
    """A panorama with GPano tags, as ``room.png`` in the working folder."""
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", gpano_xmp(tags).decode())
    Image.fromarray(rgb).save("room.png", pnginfo=text)


# Rows 8 to 28 and columns 20 to 70 of 50 × 100.
PART: dict[str, object] = {
    "FullPanoWidthPixels": 100, "FullPanoHeightPixels": 50, "CroppedAreaLeftPixels": 20,
    "CroppedAreaTopPixels": 8, "CroppedAreaImageWidthPixels": 50,
    "CroppedAreaImageHeightPixels": 20,
}  # fmt: skip
AREA = [-108, 72, -10.8, 61.2]
POSE: dict[str, object] = {"PosePitchDegrees": 30, "PoseRollDegrees": -20}


@pytest.mark.parametrize(
    ("tags", "shown", "typed", "settings"),
    [
        ({}, np.s_[8:28, 20:70], [f"area={AREA}"], {"area": AREA}),
        (PART, np.s_[8:28, 20:70], ["mask=-5"], {"mask": -5}),
        (POSE, np.s_[:], ["upright=pose"], {"upright": "pose"}),
        (
            {},
            np.s_[:],
            ["upright=auto", "max_tilt_deg=40"],
            {"upright": "auto", "max_tilt_deg": 40},
        ),
        ({}, np.s_[:], ["mask=mask.png"], {"mask": "mask.png"}),
        ({}, np.s_[:], ["mask=masks"], {"mask": Path("masks")}),
    ],
)
def test_files_get_the_labels_and_scores_of_tangent_predict(
    tmp_path: Path,
    predicted: Predicted,
    network: Network,
    monkeypatch: pytest.MonkeyPatch,
    tags: dict[str, object],
    shown: Any,
    typed: list[str],
    settings: dict[str, Any],
) -> None:
    monkeypatch.chdir(tmp_path)
    rgb = sphere(50)[shown]
    _write(rgb, tags)
    mask = np.zeros((50, 100), np.uint8)
    mask[10:30, 7:50] = 1
    Path("masks").mkdir()
    for path in ("mask.png", "masks/room.png"):
        cv2.imwrite(path, mask)
    expected, probabilities = predicted(None, *typed)
    for given in ("room.png", tmp_path / "room.png"):
        np.testing.assert_array_equal(network.labels(given, **settings), expected)
    without = {name: value for name, value in settings.items() if name != "mask"}
    np.testing.assert_allclose(
        network.probabilities("room.png", **without), probabilities, atol=1e-3
    )
    assert (expected == 0).any() == ("mask" in settings)
    if not tags and not Path(str(settings.get("mask"))).is_dir():
        np.testing.assert_array_equal(network.labels(rgb, **settings), expected)
        tensor = torch.from_numpy(rgb.copy()).permute(2, 0, 1)
        np.testing.assert_array_equal(network.labels(tensor, **settings).numpy(), expected)
    if settings.get("mask") == "mask.png":
        for array in (mask, mask > 0, torch.from_numpy(mask)):
            np.testing.assert_array_equal(network.labels(rgb, mask=array), expected)


def test_depth_is_in_meters(tmp_path: Path, predicted: Predicted) -> None:
    """Depth is missing where 0 or NaN; 16-bit files in steps of 1/512 m give equal results."""
    network = tt.load(write_checkpoint(tmp_path / "net.ckpt", TANGENT, channels=4))
    panorama = sphere(32)
    steps = np.random.default_rng(0).integers(0, 2000, (32, 64), np.uint16)
    depth_m = steps / 512
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth" / "room.png"), steps)
    expected, _ = predicted(panorama, "depth=depth", "depth_scale=512")
    np.testing.assert_array_equal(network.labels(panorama, depth=depth_m), expected)
    (tmp_path / "out").rename(tmp_path / "first")
    (tmp_path / "depth" / "room.png").unlink()
    channels = {"depth.Y": depth_m.astype(np.float32), "Normal.Z": np.ones((32, 64), np.float32)}
    OpenEXR.File({}, channels).write(str(tmp_path / "depth" / "room.exr"))
    of_channel, _ = predicted(panorama, "depth=depth", "depth_channel=depth.Y")
    np.testing.assert_array_equal(of_channel, expected)
    depth_m[depth_m == 0] = np.nan
    tensors = torch.from_numpy(panorama).permute(2, 0, 1), torch.from_numpy(depth_m)
    np.testing.assert_array_equal(network.labels(tensors[0], depth=tensors[1]), expected)
    assert (network.labels(panorama, depth=depth_m * 0) != expected).any()
    for wrong in (None, depth_m[:16], steps):
        with pytest.raises(
            SettingError, match=r"depth: .*expected floats in meters, 64 × 32 \(width × height\)"
        ):
            network.labels(panorama, depth=wrong)


@pytest.mark.parametrize("unmapped", ["unknown", "never"])
def test_label_maps_convert_labels_and_scores(
    tmp_path: Path, predicted: Predicted, unmapped: Any
) -> None:
    checkpoint = write_checkpoint(tmp_path / "net.ckpt")
    (tmp_path / "map.json").write_text('{"classes": {"light": ["bright"], "shade": ["dark"]}}')
    network = tt.load(checkpoint, label_map=tmp_path / "map.json", unmapped=unmapped)
    assert network.class_names == ("unknown", "light", "shade")
    assert len(network.palette) == 3
    expected, probabilities = predicted(sphere(32), "label_map=map.json", f"unmapped={unmapped}")
    labels, scores = network.labels(sphere(32)), network.probabilities(sphere(32))
    np.testing.assert_array_equal(labels, expected)
    np.testing.assert_allclose(scores, probabilities, atol=1e-3)
    assert (scores.sum(axis=-1).min() < 0.9) == (unmapped == "unknown")
    assert (labels == 0).any() == (unmapped == "unknown")


_RGB = np.zeros((16, 32, 3), np.uint8)


@pytest.mark.parametrize(
    ("image", "settings", "message"),
    [
        (_RGB[:, :30], {}, "a whole panorama, twice as wide as high.*area=.*fov="),
        (torch.zeros(16, 32, 3, dtype=torch.uint8), {}, r"Tensor \(16, 32, 3\).*\(3, H, W\)"),
        ("room.jpg", {}, "room.jpg: found .*No such file"),
        (_RGB, {"upright": "pose"}, "upright: found pose; expected the path of a file"),
    ],
)
def test_images_and_settings_that_do_not_fit_are_refused(
    image: Any, settings: dict[str, Any], message: str, network: Network
) -> None:
    with pytest.raises((DataError, SettingError), match=message):
        network.labels(image, **settings)


def test_a_tilt_that_is_not_a_number_is_refused(network: Any) -> None:
    with pytest.raises(TypeError, match="max_tilt_deg: found str; expected degrees"):
        network.labels(_RGB, max_tilt_deg="60")
