"""The torch backend of mosaics agrees with the compiled one and stays on one device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from tangent_train.geometry import camera_matrix_from_fov, rotation_about
from tangent_train.rendering import (
    Blend,
    CubemapRepresentation,
    EquirectRepresentation,
    HorizontalRepresentation,
    PerspectiveRepresentation,
    TangentRepresentation,
    torch_sums,
)
from tangent_train.rendering.mosaic import MeanMosaic, ScoreMosaic
from tests.fake_gpu import fake_gpu

TILT = rotation_about((1, 2, 0), 0.9)


def _photo(blend: Blend) -> Any:
    camera = PerspectiveRepresentation(level=5, fov_deg=30.0, dim=(20, 24))
    sampler = camera.of_camera(camera_matrix_from_fov(70.0, (45, 70)), (45, 70))
    return [sampler.cover(0.3 if blend == "feather" else 0.0)]


RINGS: Any = [{"pitch": pitch, "views": 6} for pitch in (0, 45, -45)]
SETS: dict[str, tuple[Callable[[Blend], Any], tuple[int, int]]] = {
    "odd size": (lambda _: TangentRepresentation(0, 5).view_sets(), (61, 123)),
    "cropped, tilted": (
        lambda _: TangentRepresentation(1, 6, crop_multiple=1).with_rotation(TILT).view_sets(),
        (101, 203),
    ),
    "rotations and levels": (
        lambda _: TangentRepresentation(0, 5, rotations=2, levels=[5, 4]).view_sets(),
        (64, 128),
    ),
    "cube": (lambda _: CubemapRepresentation(6).view_sets(), (128, 256)),
    "rings": (
        lambda blend: HorizontalRepresentation(5, RINGS, (90, 80), blend=blend).view_sets(),
        (70, 140),
    ),
    "equirectangular": (
        lambda _: EquirectRepresentation(5, rows=48, rotations=3).with_rotation(TILT).view_sets(),
        (64, 128),
    ),
    "photo": (_photo, (45, 70)),
}


def _filled(mosaic: Any, sets: Any, scores: Any) -> Any:
    for views, of_set in zip(sets, scores, strict=True):
        for start in range(0, len(views), 7):
            mosaic.add(of_set[start : start + 7], views[start : start + 7])
    return mosaic


def _scores(sets: Any, classes: int) -> list[torch.Tensor]:
    """Return scores that are smooth over the images, like those of a network."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for views in sets:
        size = views.render(np.zeros((64, 128, 3), np.uint8), "bilinear").shape[1:3]
        coarse = 4 * torch.randn(len(views), classes, 5, 5, generator=generator)
        found.append(torch.nn.functional.interpolate(coarse, size, mode="bicubic"))
    return found


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_torch_blends_depth_as_the_compiled_kernels_do(name: str, blend: Blend) -> None:
    make, shape = SETS[name]
    sets = make(blend)
    depth = [scores.where(scores > -2, torch.nan) for scores in _scores(sets, 1)]
    expected, values = (
        _filled(MeanMosaic(shape, blend, backend=backend), sets, depth).values()
        for backend in ("numba", "torch")
    )
    unknown = expected.isnan()
    # Weights at the limit differ by rounding.
    assert (values.isnan() == unknown).double().mean() > 0.9999
    assert unknown.double().mean() < 0.4
    both = ~unknown & ~values.isnan()
    torch.testing.assert_close(values[both], expected[both], atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("blend", ["nearest", "feather"])
@pytest.mark.parametrize("settings", [{}, {"averaged": True}, {"min_confidence": 0.3}])
def test_torch_agrees_with_the_compiled_kernels(
    name: str, blend: Blend, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_sums, "_ENTRIES_AT_ONCE", 2**15)
    make, shape = SETS[name]
    sets, classes = make(blend), 6
    settings = settings | {"blend": blend, "averaged": len(sets) > 1 or "averaged" in settings}
    scores = _scores(sets, classes)
    compiled, of_torch = (
        _filled(ScoreMosaic(shape, classes, backend=backend, **settings), sets, scores)
        for backend in ("numba", "torch")
    )
    expected, found = compiled.labels(), of_torch.labels()
    assert (found.dtype, found.shape) == (torch.uint8, shape)
    assert len(np.unique(expected)) >= classes
    assert (found == expected).double().mean() >= 0.9999
    if settings["averaged"]:
        for rows in (slice(None), np.array([3, 1])):
            probabilities = (mosaic.probabilities(rows) for mosaic in (of_torch, compiled))
            torch.testing.assert_close(*probabilities, atol=1e-5, rtol=0)
        monkeypatch.setattr("tangent_train.rendering.mosaic._PIXELS_AT_ONCE", 2**8)
        best = compiled.probabilities(slice(None)).amax(dim=-1)
        for mosaic in (of_torch, compiled):
            np.testing.assert_allclose(mosaic.confidences(), best, atol=1e-5)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("blend", ["nearest", "feather"])
def test_nothing_leaves_the_device(name: str, blend: Blend) -> None:
    make, shape = SETS[name]
    sets = make(blend)
    scores = _scores(sets, 4)
    for averaged in {len(sets) > 1, True}:
        with fake_gpu() as transfers:
            on_device = [torch.empty(of_set.shape) for of_set in scores]
            how: Any = {"blend": blend, "averaged": averaged, "device": "cuda"}
            how["min_confidence"] = 0.1 * averaged
            labels = _filled(ScoreMosaic(shape, 4, **how), sets, on_device).labels()
        assert labels.device.type == "cuda"
        assert set(transfers) <= {"from {'cpu'} to {'cuda'}"}
