"""Scores of panoramas and photos: those of an evaluation, at any size, for all kinds of views."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from datamodules.core.depth import distance_from_z_depth
from datamodules.core.inputs import normalize
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from models import make_distortion_aware
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, camera_matrix_from_fov
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tests.inference.trained import (
    CUBE,
    ERP,
    ICOSPHERE,
    PERSPECTIVE,
    TANGENT,
    color_network,
    sphere,
    trained_network,
)
from tests.tasks.builders import predict_labels, segmentation_task

SGD = functools.partial(torch.optim.SGD, lr=1.0)


def _labels(
    trained: LoadedNetwork, image: InputImage, per_forward: int | None = None, **settings: Any
) -> NDArray[np.unsignedinteger]:
    views = ViewSelector(trained, **settings)
    predictor = Predictor(trained, head_of(trained), views, "cpu", per_forward)
    shares: list[float] = []
    scores = predictor.predict(image, shares.append)
    assert sum(shares) == pytest.approx(1)
    return scores.labels().numpy()


def _blocks(height: int, width: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(height * width)
    blocks = rng.integers(0, 256, (-(-height // 6), -(-width // 6), 3), np.uint8)
    return blocks.repeat(6, axis=0).repeat(6, axis=1)[:height, :width]


def test_a_second_image_does_not_change_the_first() -> None:
    trained = trained_network(TANGENT)
    bright, dark = _blocks(32, 64), _blocks(32, 64)[::-1].copy()
    predictor = Predictor(trained, head_of(trained), ViewSelector(trained, blend="feather"))
    first = predictor.predict(InputImage(bright))
    expected = first.probabilities(slice(None)).numpy()
    second = predictor.predict(InputImage(dark))
    np.testing.assert_array_equal(first.probabilities(slice(None)), expected)
    assert (second.probabilities(slice(None)).numpy() != expected).any()


def _as_cuda_graphs(graph: Any, _: Any) -> Any:
    """Compile to a function that overwrites its last output, as CUDA graphs do."""
    outputs: dict[Any, torch.Tensor] = {}

    def run(*inputs: Any) -> tuple[torch.Tensor]:
        (output,) = graph(*inputs)
        return (outputs.setdefault(output.shape, torch.empty_like(output)).copy_(output),)

    return run


@pytest.mark.parametrize(
    ("device", "compiler"),
    [
        ("cpu", {"backend": _as_cuda_graphs}),
        pytest.param("cuda", {"mode": "reduce-overhead"}, marks=pytest.mark.gpu),
    ],
)
def test_a_compiled_network_predicts_the_same(device: str, compiler: dict[str, Any]) -> None:
    network: Any = nn.Sequential(nn.Conv2d(3, 1, 3, padding=1), nn.Softplus()).eval()
    changes: dict[str, Any] = {"module": network, "depth_kind": "metric_distance"}
    trained = trained_network(TANGENT, class_names=(), **changes)
    predicted = [
        Predictor(trained, head_of(trained), ViewSelector(trained), device, 4, compile=arguments)
        .predict(InputImage(_blocks(32, 64)))
        .pixels()
        for arguments in (None, compiler)
    ]
    torch.testing.assert_close(*predicted)


# Panoramas.


@pytest.mark.parametrize(
    ("representation", "settings", "channels", "upright"),
    [
        (TANGENT, {"blend": "feather"}, 3, True),
        (TANGENT | {"crop_multiple": 2}, {"blend": "nearest"}, 3, False),
        (ERP, {}, 3, True),  # a single image
        (CUBE, {"blend": "feather"}, 4, False),  # its faces do not overlap
        (CUBE | {"margin": 4}, {"blend": "feather", "rotations": 2}, 3, True),
        (TANGENT, {"blend": "nearest", "rotations": 3}, 4, True),
        (TANGENT, {"blend": "feather", "levels": [4, 3]}, 4, False),
        (ERP, {"rotations": 3}, 4, False),
        (ERP | {"rows": 24}, {"rotations": 2}, 3, True),
        (ICOSPHERE, {"rotations": 2}, 4, True),
        (ICOSPHERE | {"elements": "faces", "interpolation": "nearest"}, {}, 3, False),
        (ERP | {"distortion_aware": True}, {"rotations": 2}, 3, True),
    ],
)
def test_labels_are_those_of_an_evaluation(
    stanford_root: Path,
    representation: dict[str, Any],
    settings: dict[str, Any],
    channels: int,
    upright: bool,
) -> None:
    trained = trained_network(representation, channels)
    made = build_from_config(representation | settings, "representation")
    data = Stanford2D3DS(
        root=stanford_root, representation=made, inputs=trained.inputs, fold=1, test_rotation=30
    )
    data.upright = "pose" if upright else None
    task = segmentation_task(trained.network, made, trained.class_names, SGD)
    batch = next(iter(data.test_dataloader()))
    batch = data.on_after_batch_transfer(batch, 0)
    shape, rotation = tuple(batch.labels[0].shape), batch.rotation[0].numpy()
    expected = predict_labels(task, batch.images[0], shape, rotation).numpy()
    read = data.dataset("test").read(int(batch.index[0]))
    assert (read.up is not None) == upright
    labels = _labels(trained, InputImage(read.rgb, read.depth, read.up), 7, **settings)
    assert len(np.unique(expected)) > 1
    np.testing.assert_array_equal(labels + 1, expected)


def test_convolutions_are_sampled_on_the_sphere_if_the_views_ask_for_it() -> None:
    plain = trained_network(ERP)
    aware = trained_network(ERP | {"distortion_aware": True})
    image = InputImage(_blocks(32, 64))
    converted = trained_network(ERP, module=make_distortion_aware(plain.module))
    expected = _labels(converted, image)
    np.testing.assert_array_equal(_labels(aware, image), expected)
    assert (_labels(plain, image) != expected).mean() > 0.01
    area = (-90, 90, -30, 30)
    assert ViewSelector(plain).description(area) == "1 view of 64 × 32"
    assert ViewSelector(aware).description(area) == "1 view of 64 × 32"
    with pytest.raises(SettingError, match=r"features of 32 × 32 .*; expected whole equirect"):
        _labels(replace(aware, fixed_size=(32, 32)), image)


def test_elevation_follows_the_zenith() -> None:
    """A network that only uses elevation: up is one class, down another."""
    network = torch.nn.Conv2d(4, 3, 1)
    with torch.no_grad():
        network.weight.zero_()
        network.weight[0, 3], network.weight[2, 3] = -1, 1
        network.bias.copy_(torch.tensor([0.0, -9, 0]))  # type: ignore[union-attr]
    trained = trained_network(TANGENT, module=network, inputs=("rgb", "elevation"))
    labels = _labels(trained, InputImage(sphere(32)))
    assert (labels[:15] == 2).all()
    assert (labels[17:] == 0).all()
    tilted = _labels(trained, InputImage(sphere(32), up=np.array([1.0, 0.0, 0.0])))
    assert (tilted[:, 20:44] == 2).mean() > 0.85, "around the middle column"
    with pytest.raises(SettingError, match="image: found a photo; expected a panorama"):
        _labels(trained, _photo(sphere(32), 60.0))


@pytest.mark.parametrize(("representation", "height"), [(TANGENT, 16), (CUBE, 50), (ERP, 96)])
def test_panoramas_of_any_size_get_labels_of_their_size(
    representation: dict[str, Any], height: int
) -> None:
    """With smooth colors, labels equal those of a network applied to each pixel."""
    rgb = sphere(height)
    labels = _labels(trained_network(representation), InputImage(rgb))
    assert labels.shape == (height, 2 * height)
    expected = _labels(trained_network(ERP | {"erp_height": height}), InputImage(rgb))
    assert (labels == expected).mean() > 0.9


def test_a_larger_panorama_is_shrunk_without_aliasing() -> None:
    """A checkerboard finer than the network's pixels becomes gray."""
    board = (np.indices((128, 256)).sum(axis=0) % 2 * 255).astype(np.uint8)
    rgb = cv2.cvtColor(board, cv2.COLOR_GRAY2RGB)
    trained = trained_network(TANGENT)
    expected = _labels(trained, InputImage(np.full_like(rgb, 128)))
    np.testing.assert_array_equal(_labels(trained, InputImage(rgb)), expected)


def test_pixels_of_low_confidence_are_unknown() -> None:
    groups = [[0], [1], [2]]  # of which the last means nothing
    names = ("unknown", "dark", "green")
    trained = trained_network(TANGENT, class_names=names, groups=groups)
    predictor = Predictor(trained, head_of(trained, min_confidence=0.6), ViewSelector(trained))
    scores = predictor.predict(InputImage(sphere(32)))
    probabilities = scores.probabilities(slice(None)).numpy()
    best = probabilities.argmax(axis=-1)
    known = (best < 2) & (probabilities.max(axis=-1) >= 0.6)
    assert all(((best == k) & known).any() != (k == 2) for k in range(3))
    np.testing.assert_array_equal(scores.pixels(), np.where(known, best + 1, 0))


def test_level_and_base_level_choose_the_views() -> None:
    def views(representation: dict[str, Any], **settings: Any) -> tuple[int, int]:
        (found,) = ViewSelector(trained_network(representation), **settings)(
            InputImage(sphere(128))
        )
        (seen,) = found.sets
        return len(seen), seen.render(found.image.rgb, "bilinear").shape[1]

    assert views(TANGENT) == (20, 16)
    assert views(TANGENT, levels=5) == (20, 32)
    assert views(TANGENT, base_level=1) == (80, 8)
    assert views(ERP, base_level=1) == (80, 8)
    assert views(PERSPECTIVE) == (80, 32), "of networks trained on photos, base level 1"


# Photos.


def _photo(rgb: NDArray[np.uint8], fov_deg: float, **more: Any) -> InputImage:
    size = rgb.shape[0], rgb.shape[1]
    return InputImage(rgb, camera_matrix=camera_matrix_from_fov(fov_deg, size), **more)


def _radians_per_pixel(trained: LoadedNetwork, **settings: Any) -> float:
    (found,) = ViewSelector(trained, **settings)(_photo(_blocks(12, 12), 90.0))
    left, _, right, _ = found.sets[0].boxes[0]  # type: ignore[attr-defined]
    return float(right - left) / 6 / ViewSelector(trained, **settings).crops[0].image_size[1]


@pytest.mark.parametrize(
    ("blend", "channels", "size"),
    [
        ("nearest", 3, (24, 24)),
        ("nearest", 4, (48, 72)),
        ("nearest", 3, (10, 61)),
        ("feather", 4, (48, 72)),
        ("feather", 3, (7, 9)),
    ],
)
def test_photos_with_the_networks_pixels_are_labeled_pixel_by_pixel(
    blend: str, channels: int, size: tuple[int, int]
) -> None:
    """Crops aligned with the photo's pixels and a network without context: labels must not move."""
    network = color_network(channels, kernel=1)
    trained = trained_network(PERSPECTIVE, channels, module=network)
    pixel = 2 * math.tan(math.radians(22.5)) / 24
    image = _photo(_blocks(*size), 2 * math.degrees(math.atan(pixel * size[1] / 2)))
    inputs = [torch.from_numpy(image.rgb)[None]]
    if channels == 4:
        z_depth = 300 + 5 * image.rgb[..., 0].astype(np.uint16)
        assert image.camera_matrix is not None
        depth = distance_from_z_depth(z_depth, image.camera_matrix)
        inputs.append(torch.from_numpy(depth.astype(np.int32))[None])
        image = InputImage(image.rgb, z_depth, camera_matrix=image.camera_matrix)
    with torch.no_grad():
        images = normalize(inputs, trained.normalization, trained.inputs)
        expected = network(images)[0].argmax(0).numpy()
    labels = _labels(trained, image, blend=blend)
    if blend == "nearest" and size != (10, 61):
        np.testing.assert_array_equal(labels, expected)
    else:  # crops lie between whole pixels
        assert (labels == expected).mean() > 0.9


def test_crops_have_the_angular_resolution_the_network_was_trained_with() -> None:
    tangent, photos = trained_network(TANGENT), trained_network(PERSPECTIVE)
    assert _radians_per_pixel(tangent) == pytest.approx(TangentGrid(0, 4).pitch)
    assert _radians_per_pixel(tangent, levels=5) == pytest.approx(TangentGrid(0, 5).pitch)
    assert _radians_per_pixel(tangent, base_level=1) == pytest.approx(TangentGrid(1, 4).pitch)
    at_45 = 2 * math.tan(math.radians(22.5)) / 24
    assert _radians_per_pixel(photos) == pytest.approx(at_45)
    assert _radians_per_pixel(photos, levels=7) == pytest.approx(at_45 / 2)
    assert _radians_per_pixel(trained_network(ERP)) == pytest.approx(TangentGrid(1, 4).pitch)
    assert _radians_per_pixel(trained_network(CUBE)) == pytest.approx(2 / 16)


# Invalid settings.


@pytest.mark.parametrize(("representation", "size"), [(ICOSPHERE, (1, 2562)), (ERP, (32, 64))])
def test_a_network_of_whole_spheres_takes_only_those_of_its_training(
    representation: dict[str, Any], size: tuple[int, int]
) -> None:
    trained = trained_network(representation, fixed_size=size)
    expected = f"expected {size[1]} × {size[0]} .* labels whole panoramas"
    changes: dict[str, Any]
    for changes in ({"levels": 5}, {"views": "horizontal"}, {"base_level": 1}):
        with pytest.raises(SettingError, match=expected):
            _ = ViewSelector(trained, **changes).representation
    with pytest.raises(SettingError, match=expected):
        _labels(trained, _photo(sphere(32), 60.0))
    assert ViewSelector(trained, 4).representation.image_size == size


class _HalfKnown(nn.Module):
    """Scores of `color_network`; those of one class are `wrong` where red is below its mean."""

    def __init__(self, wrong: float) -> None:
        super().__init__()
        self.network, self.wrong = color_network(), wrong

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        scores: torch.Tensor = self.network(images)
        scores[:, 1] = scores[:, 1].where(images[:, 0] > 0, self.wrong)
        return scores


@pytest.mark.parametrize(
    ("representation", "blend", "wrong"),
    [
        (TANGENT, "nearest", torch.nan),
        (TANGENT, "feather", torch.inf),
        (ERP, "nearest", torch.inf),
        (ICOSPHERE, "nearest", torch.nan),
        (PERSPECTIVE, "feather", torch.nan),
    ],
)
def test_scores_that_are_not_finite_are_unknown(
    representation: Any, blend: Any, wrong: float
) -> None:
    image = _photo(sphere(32), 90.0) if representation is PERSPECTIVE else InputImage(sphere(32))
    usual = _labels(trained_network(representation), image, blend=blend)
    module: Any = _HalfKnown(wrong)
    found = _labels(trained_network(representation, module=module), image, blend=blend)
    red = image.rgb[..., 0].astype(int)
    np.testing.assert_array_equal(found[red < 90], 3)  # index K
    np.testing.assert_array_equal(found[red > 160], usual[red > 160])
