"""Features on a coarse sphere: against loops, closed forms, and what a sphere looks like turned."""

from __future__ import annotations

import copy
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models import SphereContext, SphereRendering, UNet
from models.sphere_rendering import equirect_to_tokens, pad_equirect, tokens_to_equirect
from tangent_train.checkpoints.trained import load_trained
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    equirect_to_lonlat,
    lonlat_to_xyz,
    rotation_about,
)
from tangent_train.tasks.export import export_network
from tests.rendering.reference import sample_panorama, to_lonlat
from tests.tasks.odd_networks import assert_same, scores_of, some_images
from tests.tasks.small_networks import small_trained

SHAPE = (8, 16)
PIXELS = torch.from_numpy(equirect_directions(SHAPE))
TURN = rotation_about((1, -2, 0.5), 2.3)


def token_directions(
    grid: TangentGrid, rows: int, columns: int, faces: list[int] | None = None
) -> Tensor:
    """``(n, 3, rows, columns)`` float64: the middles of equal parts of each image."""
    half = grid.pitch * grid.dim / 2
    x = ((2 * np.arange(columns) + 1) / columns - 1) * half
    y = ((2 * np.arange(rows) + 1) / rows - 1) * half
    rays = np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
    turned = np.einsum("nij,rcj->nirc", grid.world_from_camera, rays)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return torch.from_numpy(turned if faces is None else turned[faces])


def even_directions(count: int) -> Tensor:
    """``(count, 3)`` float64, on a spiral from pole to pole in steps of the golden angle."""
    z = 1 - (2 * torch.arange(count, dtype=torch.float64) + 1) / count
    lon_rad = torch.arange(count, dtype=torch.float64) * (math.pi * (3 - math.sqrt(5)))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * lon_rad.cos(), radius * lon_rad.sin(), z], dim=-1)


def some_directions(spheres: int = 2, images: int = 3, rows: int = 2, columns: int = 3) -> Tensor:
    """Other faces, turned otherwise, for every sphere."""
    rng = np.random.default_rng(0)
    return torch.stack(
        [
            token_directions(
                TangentGrid(0, 4, rotation=rotation_about(rng.normal(size=3), 1 + sphere)),
                rows,
                columns,
                rng.choice(20, images, replace=False).tolist(),
            )
            for sphere in range(spheres)
        ]
    )


def trained(channels: int = 4, seed: int = 0, **settings: Any) -> SphereRendering:
    """One that adds something, in float64."""
    torch.manual_seed(seed)
    mixer = SphereRendering(channels, **{"width": 5, "rows": 8, "dilations": (1, 2), **settings})
    nn.init.normal_(mixer.expand.weight)
    nn.init.normal_(mixer.norm.weight, 1, 0.3)
    return mixer.double()


def random_tokens(directions: Tensor, channels: int = 4, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (*directions.shape[:2], channels, *directions.shape[3:])
    return torch.randn(shape, dtype=torch.float64, generator=generator)


def angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return 2 * math.asin(min(1.0, float(np.linalg.norm(a - b)) / 2))


def reference_panorama(
    tokens: NDArray[np.float64], directions: NDArray[np.float64], spread: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One sphere, token by token: ``(n, C, h, w)`` and ``(n, 3, h, w)``."""
    images, channels, rows, columns = tokens.shape
    total, weights = np.zeros((channels, *SHAPE)), np.zeros(SHAPE)
    for image in range(images):
        places = directions[image]
        squares = [
            float(((places[:, r, c] - places[:, r + i, c + j]) ** 2).sum())
            for r in range(rows)
            for c in range(columns)
            for i, j in ((0, 1), (1, 0))
            if r + i < rows and c + j < columns
        ]
        spacing = math.sqrt(np.mean(squares)) if squares else 0.0
        sigma = spread * max(spacing, math.pi / SHAPE[0])
        for index in np.ndindex(rows, columns):
            for pixel in np.ndindex(SHAPE):
                theta = angle(places[:, *index], PIXELS.numpy()[pixel])
                weight = math.exp((math.cos(theta) - 1) / sigma**2)
                weights[pixel] += weight
                total[:, *pixel] += weight * tokens[image, :, *index]
    least = math.exp(-1 / (2 * spread**2))
    return total / np.maximum(weights, least), weights / np.maximum(weights, least)


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (1, 1), (3, 1), (4, 4)])
@pytest.mark.parametrize("spread", [0.5, 0.3])
def test_averages_are_those_of_slow_loops(rows: int, columns: int, spread: float) -> None:
    directions = some_directions(2, 3, rows, columns)
    tokens = random_tokens(directions)
    panoramas, coverage = tokens_to_equirect(tokens, directions, PIXELS, spread)
    assert panoramas.shape == (2, 4, *SHAPE)
    assert coverage.shape == (2, 1, *SHAPE)
    for s in range(2):
        values, seen = reference_panorama(tokens[s].numpy(), directions[s].numpy(), spread)
        np.testing.assert_allclose(panoramas[s].numpy(), values, atol=1e-9)
        np.testing.assert_allclose(coverage[s, 0].numpy(), seen, atol=1e-9)


@pytest.mark.parametrize("shape", [SHAPE, (5, 10), (7, 13)])
def test_sampling_is_that_of_the_reference(shape: tuple[int, int]) -> None:
    directions = some_directions(2, 6, 3, 2)
    edges = [[0.0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, -1e-9, 0], [-1, 1e-3, 5], [0.1, 0.1, -7]]
    for place, edge in enumerate(edges):
        directions[1, place, :, 0, 0] = torch.tensor(edge)
    panoramas = torch.randn(2, 3, *shape, dtype=torch.float64)
    values = equirect_to_tokens(panoramas, directions)
    assert values.shape == (2, 6, 3, 3, 2)
    for s in range(2):
        xyz = directions[s].movedim(1, -1).numpy()
        lonlat = to_lonlat(xyz / np.linalg.norm(xyz, axis=-1, keepdims=True))
        image = panoramas[s].movedim(0, -1).numpy()
        expected = sample_panorama(image, lonlat, "bilinear")
        np.testing.assert_allclose(values[s].movedim(1, -1).numpy(), expected, atol=1e-9)


@pytest.mark.parametrize("faces", [None, [3], [0, 1]])
def test_a_constant_stays_one_where_it_is_covered(faces: list[int] | None) -> None:
    directions = token_directions(TangentGrid(0, 5, rotation=TURN), 3, 3, faces)[None]
    tokens = torch.full((1, directions.shape[1], 1, 3, 3), 2.5, dtype=torch.float64)
    panoramas, coverage = tokens_to_equirect(tokens, directions, PIXELS)
    torch.testing.assert_close(panoramas, 2.5 * coverage)
    assert 0 <= coverage.min() <= coverage.max() <= 1 + 1e-12
    flat = directions[0].movedim(1, -1).reshape(-1, 3).numpy()
    spacing_rad = np.mean([angle(*directions[0, 0, :, 1, i : i + 2].T.numpy()) for i in range(2)])
    for pixel in np.ndindex(SHAPE):
        nearest_rad = min(angle(PIXELS.numpy()[pixel], token) for token in flat)
        seen = float(coverage[0, 0, *pixel])
        if nearest_rad < 0.9 * spacing_rad:
            assert seen == pytest.approx(1)
        if nearest_rad > 3 * spacing_rad:
            assert seen < 1e-4
    if faces is None:
        torch.testing.assert_close(coverage, torch.ones_like(coverage))
    else:
        assert coverage.min() < 1e-4


def test_a_direction_survives_the_round_trip_up_to_the_blur() -> None:
    """Every harmonic of degree 1 comes back times coth κ − 1/κ, the mean of cos θ (Mardia 1972)."""
    rows, spread = 16, 1.0
    pixels = torch.from_numpy(equirect_directions((rows, 2 * rows)))
    directions = even_directions(4000)[None, :, :, None, None]  # of images with one token each
    panoramas, coverage = tokens_to_equirect(directions, directions, pixels, spread)
    assert coverage.min() > 1 - 1e-9
    kappa = (rows / math.pi / spread) ** 2
    expected = (1 / math.tanh(kappa) - 1 / kappa) * pixels.movedim(-1, 0)
    assert (panoramas[0] - expected).norm(dim=0).max() < 1e-3  # by 4000 tokens, not all directions
    again = equirect_to_tokens(panoramas, directions)
    # Between pixels a bilinear patch lies within h²/4 of a direction.
    assert (again - directions).norm(dim=2).max() < 1 / kappa + 1e-3 + (math.pi / rows) ** 2 / 4


@pytest.mark.parametrize(("tokens", "tolerance"), [(3, 0.09), (4, 0.06)])
def test_what_varies_slowly_survives_the_cropped_images_of_an_icosahedron(
    tokens: int, tolerance: float
) -> None:
    """48 pixels of level 6 with a few tokens, as the module is used: mostly blur, σ² = 0.06."""
    directions = token_directions(TangentGrid(0, 6, dim=48, rotation=TURN), tokens, tokens)[None]
    pixels = torch.from_numpy(equirect_directions((16, 32)))
    panoramas, coverage = tokens_to_equirect(directions, directions, pixels)
    assert coverage.min() > 1 - 1e-9
    again = equirect_to_tokens(panoramas, directions)
    assert (again - directions).norm(dim=2).max() < tolerance


def test_padding_continues_over_seam_and_poles() -> None:
    margin = 3
    ours = pad_equirect(PIXELS.movedim(-1, 0), margin)
    u, v = np.arange(-margin, SHAPE[1] + margin), np.arange(-margin, SHAPE[0] + margin)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    # Latitudes beyond 90° are directions beyond the pole.
    expected = lonlat_to_xyz(equirect_to_lonlat(pixels, SHAPE))
    np.testing.assert_allclose(ours.movedim(0, -1).numpy(), expected, atol=1e-12)
    assert pad_equirect(PIXELS.movedim(-1, 0), SHAPE[0]).shape == (3, 24, 32)


def test_nothing_is_added_before_it_is_trained() -> None:
    directions = some_directions().float()
    tokens = random_tokens(directions).float()
    mixer = SphereRendering(4)
    assert not mixer(tokens, directions).any()
    mixer(tokens, directions).sum().backward()
    with torch.no_grad():
        assert mixer.expand.weight.grad is not None
        mixer.expand.weight -= 0.1 * mixer.expand.weight.grad
    mixer.zero_grad()
    mixer(tokens, directions).square().sum().backward()
    gradients = {name: p.grad for name, p in mixer.named_parameters()}
    assert not [name for name, g in gradients.items() if g is None or not g.any()]


def test_gradients_are_those_of_differences() -> None:
    directions = some_directions(2, 2, 1, 2)
    mixer = trained(2, width=2, rows=3, dilations=(1, 3))
    tokens = random_tokens(directions, 2).requires_grad_()
    parameters = dict(mixer.named_parameters())

    def call(x: Tensor, *values: Tensor) -> Tensor:
        named = dict(zip(parameters, values, strict=True))
        result: Tensor = torch.func.functional_call(mixer, named, (x, directions))
        return result

    assert torch.autograd.gradcheck(call, (tokens, *parameters.values()))


def test_spheres_do_not_see_each_other() -> None:
    directions = some_directions(3)
    mixer, tokens = trained(), random_tokens(directions)
    expected = torch.cat([mixer(t[None], d[None]) for t, d in zip(tokens, directions, strict=True)])
    torch.testing.assert_close(mixer(tokens, directions), expected)
    tokens.requires_grad_()
    mixer(tokens, directions)[1].sum().backward()
    assert tokens.grad is not None
    assert [bool(g.any()) for g in tokens.grad] == [False, True, False]
    assert all(bool(g.any()) for g in tokens.grad[1])


def test_images_of_a_sphere_see_each_other_in_any_order() -> None:
    directions = token_directions(TangentGrid(0, 5), 2, 2)[None]
    mixer, tokens = trained(), random_tokens(directions)
    result = mixer(tokens, directions)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(mixer(tokens[:, order], directions[:, order]), result[:, order])
    alone = mixer(tokens[:, :1], directions[:, :1])
    assert (alone - result[:, :1]).abs().max() > 0.1
    subset = mixer(tokens[:, :7], directions[:, :7])
    assert (subset - result[:, :7]).abs().max() > 0.01


def test_a_mirrored_image_is_the_same_image() -> None:
    directions = some_directions()
    mixer, tokens = trained(), random_tokens(directions)
    mirrored = mixer(tokens.flip(-1), directions.flip(-1)).flip(-1)
    torch.testing.assert_close(mirrored, mixer(tokens, directions))


@pytest.mark.parametrize("columns", [1, 5, -8])
def test_turning_by_whole_columns_changes_nothing(columns: int) -> None:
    directions = some_directions()
    mixer, tokens = trained(), random_tokens(directions)
    turn = torch.from_numpy(rotation_about((0, 0, 1), columns / 16 * 2 * math.pi))
    turned = torch.einsum("ij,snjrc->snirc", turn, directions)
    panoramas, _ = tokens_to_equirect(tokens, directions, PIXELS)
    moved, _ = tokens_to_equirect(tokens, turned, PIXELS)
    torch.testing.assert_close(moved, panoramas.roll(columns, -1))
    torch.testing.assert_close(mixer(tokens, turned), mixer(tokens, directions))


@pytest.mark.parametrize("spread", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 3), (2, 1)])
def test_one_image_alone_is_finite_in_single_precision(
    size: tuple[int, int], spread: float
) -> None:
    directions = some_directions(2, 1, *size).float()
    directions[0, 0, :, 0, 0] = torch.tensor([0.0, 0.0, -1.0])
    mixer = trained(rows=16, spread=spread).float()
    tokens = random_tokens(directions).float().requires_grad_()
    result = mixer(tokens, directions)
    result.sum().backward()
    assert tokens.grad is not None
    assert result.isfinite().all()
    assert tokens.grad.isfinite().all()
    wide = copy.deepcopy(mixer).double()(tokens.double(), directions.double())
    torch.testing.assert_close(result.double(), wide, atol=1e-4, rtol=1e-4)


def test_no_images_at_all() -> None:
    mixer = trained()
    result = mixer(torch.zeros(2, 0, 4, 2, 2).double(), torch.zeros(2, 0, 3, 2, 2).double())
    assert result.shape == (2, 0, 4, 2, 2)


def test_autocast_rounds_and_no_more() -> None:
    directions = token_directions(TangentGrid(0, 5), 3, 3)[None].float()
    mixer = trained().float()
    tokens = random_tokens(directions).float()
    expected = mixer(tokens, directions)
    with torch.autocast("cpu", torch.bfloat16):
        found = mixer(tokens, directions)
        assert found.dtype == torch.bfloat16
        found.float().square().sum().backward()
    assert (found - expected).norm() < 0.02 * expected.norm()


def test_shapes_without_numbers_and_copies() -> None:
    mixer = trained()
    copied = copy.deepcopy(mixer)
    directions = some_directions()
    tokens = random_tokens(directions)
    torch.testing.assert_close(copied(tokens, directions), mixer(tokens, directions))
    found = copied.to("meta")(tokens.to("meta"), directions.to("meta"))
    assert found.is_meta
    assert found.shape == tokens.shape
    assert not [name for name in mixer.state_dict() if "pixels" in name], "follow from the settings"


def test_a_trace_holds_for_other_numbers_of_spheres_images_and_tokens() -> None:
    mixer = trained()
    directions = some_directions(2, 3, 4, 5)
    free = dict.fromkeys((0, 1, 3, 4), torch.export.Dim.DYNAMIC)
    program = torch.export.export(
        mixer, (random_tokens(directions), directions), dynamic_shapes=(free, free)
    )
    traced = program.module()
    for sizes in ((2, 3, 4, 5), (5, 1, 4, 4), (1, 7, 9, 6), (1, 1, 3, 3)):
        directions = some_directions(*sizes)
        tokens = random_tokens(directions)
        torch.testing.assert_close(traced(tokens, directions), mixer(tokens, directions))


@pytest.mark.slow
def test_exported_networks_compute_the_same(tmp_path: Path) -> None:
    mixer: Any = partial(SphereRendering, width=5, rows=8, dilations=(1, 2))
    network = SphereContext(UNet(4, 5, (4, 8)), "downs.0", mixer, in_channels=4)
    nn.init.normal_(network.get_parameter("mixer.expand.weight"))
    trained_network = small_trained(network=network)
    path = tmp_path / "net.onnx"
    assert export_network(trained_network, path, "onnx").trained.fixed_size is None
    again = load_trained(path).network
    for size in ((2, 6), (10, 10), (16, 50)):
        images = some_images(trained_network, 3, size)
        expected = scores_of(trained_network, images)
        assert_same(again(images).detach(), expected)
        assert (network.network(images) - expected).abs().max() > 0.01


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 0}, "width of SphereRendering: found 0; expected 1 or more"),
        ({"dilations": ()}, r"dilations of SphereRendering: found \[\]"),
        ({"dilations": (1, 0)}, r"found \[1, 0\]; expected one or more from 1 to its 16 rows"),
        ({"rows": 4, "dilations": (5,)}, r"found \[5\]; expected one or more from 1 to its 4 rows"),
        ({"rows": 0}, "to its 0 rows"),
        ({"spread": 0.05}, "spread of SphereRendering: found 0.05; expected 0.1 or more"),
        ({"spread": float("nan")}, "found nan"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        SphereRendering(8, **settings)
