"""Prediction on a device: rendering, network and mosaic do not leave it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.heads import head_of
from tangent_train.inference.engine import Predictor, RenderedViews
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector
from tests.fake_gpu import fake_gpu
from tests.inference.trained import (
    CUBE,
    ERP,
    ICOSPHERE,
    PERSPECTIVE,
    TANGENT,
    sphere,
    trained_network,
)

UP = np.array([0.6, 0, 0.8])


def _image(height: int, **more: Any) -> InputImage:
    rgb = sphere(height)
    depth = (rgb[..., 0].astype(np.uint16) * 12).clip(0, 2**16 - 1)
    return InputImage(rgb, depth, **more)


def _photo(rows: int) -> InputImage:
    size = (rows, 3 * rows // 2)
    rgb = np.ascontiguousarray(sphere(rows)[:, : size[1]])
    return InputImage(rgb, camera_matrix=camera_matrix_from_fov(75.0, size))


INPUTS = {"rgb": 3, "depth": 1, "elevation": 1}
CASES: dict[str, tuple[dict[str, Any], tuple[str, ...], InputImage, dict[str, Any]]] = {
    "tangent": (TANGENT, ("rgb", "depth", "elevation"), _image(32, up=UP), {"rotations": 2}),
    "shrunk": (TANGENT, ("rgb", "depth"), _image(75), {"levels": [4, 3], "blend": "nearest"}),
    "cube": (CUBE, ("rgb",), _image(31), {}),
    "equirectangular": (ERP, ("rgb", "depth"), _image(40, up=UP), {"rotations": 3}),
    "icosphere": (ICOSPHERE, ("rgb", "depth"), _image(40, up=UP), {"rotations": 2}),
    "on faces": (ICOSPHERE | {"elements": "faces"}, ("rgb", "elevation"), _image(32), {}),
    "photo": (PERSPECTIVE, ("rgb",), _photo(48), {}),
    "small photo": (PERSPECTIVE, ("rgb",), _photo(11), {"blend": "nearest"}),
}


def _case(name: str) -> tuple[LoadedNetwork, InputImage, Any]:
    representation, inputs, image, settings = CASES[name]
    network = torch.nn.Conv2d(sum(INPUTS[name] for name in inputs), 3, 1).eval()
    channels = 4 if "depth" in inputs else 3
    trained = trained_network(representation, channels, module=network, inputs=inputs)
    return trained, image, ViewSelector(trained, **settings)


@pytest.mark.parametrize("name", CASES)
def test_only_the_image_goes_to_the_device_and_only_labels_come_back(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained, image, views = _case(name)
    monkeypatch.setattr(trained.network, "to", lambda *_, **__: trained.network)
    with fake_gpu(trained.network) as transfers:
        predictor = Predictor(trained, head_of(trained), views, "cuda", 3)
        transfers.clear()
        labels = predictor.predict(image).labels()
    assert labels.device.type == "cuda"
    assert tuple(labels.shape) == image.shape
    assert set(transfers) == {"from {'cpu'} to {'cuda'}"}


@pytest.mark.parametrize("name", CASES)
def test_tensors_are_rendered_like_arrays(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of 0 to 255, up to the precision of positions of OpenCV, and the other inputs."""
    trained, image, views = _case(name)

    def rendered() -> list[NDArray[np.float32]]:
        return [
            RenderedViews(trained, shown, shape, "cpu")(part).numpy()
            for shown, shape, sets, _ in views(image)
            for part in sets
        ]

    expected = rendered()
    monkeypatch.setattr("tangent_train.inference.engine.renders_arrays", lambda _: False)
    found = rendered()
    for of_set, wanted in zip(found, expected, strict=True):
        assert of_set.shape == wanted.shape
        difference = np.abs(of_set - wanted)
        assert np.quantile(difference, 0.99) < 0.05
