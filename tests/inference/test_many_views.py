"""Networks that take all views of a panorama in one call, with their cameras."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.cameras import cameras_of_rays, rotation_error_deg
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.config.build import build_from_config
from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    camera_matrix_from_fov,
    equirect_directions,
    rotation_about,
)
from tangent_train.heads import head_of
from tangent_train.heads.alignment import AlignedMosaic
from tangent_train.inference.engine import Predictor, upright_rays
from tangent_train.inference.images import InputImage
from tangent_train.inference.views import ViewSelector, view_settings
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering import TangentRepresentation, tangent_to_equirect
from tangent_train.rendering.representations.views import PinholeViews
from tests.inference.trained import CUBE, ERP, TANGENT, trained_network

CENTER, RADIUS = (0.5, 0.3, -0.2), 2.0
"""Center of a ball-shaped room in the right-handed axes of the world, and its radius, in meters."""

SHAPE = 128, 256
UNIT = Normalization([0.0] * 3, [1.0] * 3)
VIEWS: dict[str, dict[str, Any]] = {
    "tangent": TANGENT | {"level": 7},
    "horizontal": view_settings("horizontal") | {"level": 7, "dim": [192, 320], "rotations": 2},
    "joint": view_settings("horizontal_wide") | {"level": 7, "dim": 320},
    "cube": CUBE | {"level": 7, "margin": 18},
}


def ball_distance(directions: Any) -> Any:
    """Return the distance of the wall in unit directions ``(…, 3)`` of the right-handed world."""
    along = directions @ directions.new_tensor(CENTER)
    return along + (along**2 + RADIUS**2 - sum(c**2 for c in CENTER)).sqrt()


def true_distances(shape: tuple[int, int] = SHAPE) -> NDArray[np.float64]:
    directions = torch.from_numpy(equirect_directions(shape) * (1, -1, 1))
    found: NDArray[np.float64] = ball_distance(directions).numpy()
    return found


class Ball(nn.Module):
    """Computes z-depth of the room from the cameras alone, in float64.

    Args:
        convention: Mistake of the network: ``transposed``, ``left-handed`` or ``corner``.
        tilt_deg: Angle by which every second one of its own rotations is wrong.
    """

    def __init__(self, convention: str = "right", tilt_deg: float = 0.0) -> None:
        super().__init__()
        self.convention, self.calls = convention, 0
        self.tilt = torch.from_numpy(rotation_about((1, 2, 3), np.radians(tilt_deg))).float()

    def forward(self, images: Tensor, world_from_camera: Tensor, camera_matrix: Tensor) -> Any:
        self.calls += 1
        rotation, inverse = world_from_camera.double(), camera_matrix.double().inverse()
        if self.convention == "transposed":
            rotation = rotation.mT
        if self.convention == "left-handed":
            rotation = rotation * torch.tensor([1, -1, 1])[:, None]
        rows, columns = (torch.arange(n).double() for n in images.shape[-2:])
        shift = 0.5 * (self.convention == "corner")
        v, u = torch.meshgrid(rows + shift, columns + shift, indexing="ij")
        rays = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ inverse.mT[:, None]
        lengths = rays.norm(dim=-1)
        distance = ball_distance(rays @ rotation.mT[:, None] / lengths[..., None])
        own = world_from_camera.clone()
        own[::2] = own[::2] @ self.tilt
        turned = torch.from_numpy(rotation_about((3, -1, 2), 1.0)).float()
        return {"out": (distance / lengths).float(), "world_from_camera": turned @ own}


def many_view_network(module: nn.Module, name: str = "tangent") -> LoadedNetwork:
    changes: dict[str, Any] = {"module": module, "normalization": UNIT}
    return trained_network(VIEWS[name], class_names=(), depth_kind="metric_z", **changes)


def predicted(loaded: LoadedNetwork, align: Any = "none", **image: Any) -> Any:
    panorama = InputImage(np.zeros((*SHAPE, 3), np.uint8), **image)
    head = head_of(loaded, align=align)
    return Predictor(loaded, head, ViewSelector(loaded), view_batch_size=2).predict(panorama)


@pytest.mark.parametrize("name", VIEWS)
def test_a_network_that_knows_the_answer_is_exact(name: str) -> None:
    network = Ball(tilt_deg=3.0)
    loaded = many_view_network(network, name)
    mosaic = predicted(loaded)
    np.testing.assert_allclose(mosaic.pixels().numpy(), true_distances(), rtol=1e-4)
    assert network.calls == 1, "also with views of two sizes or rotations"
    # A half is wrong by 3°, about different axes of the world.
    assert 1 < float(mosaic.facts["rotation_error_deg"]) < 3


@pytest.mark.parametrize("convention", ["transposed", "left-handed", "corner"])
def test_a_wrong_convention_is_noticed(convention: str) -> None:
    found = predicted(many_view_network(Ball(convention))).pixels().numpy()
    error = np.abs(found / true_distances() - 1)
    assert np.quantile(error, 0.9) > (1e-3 if convention == "corner" else 0.1)


def test_tilted_panoramas_get_upright_cameras() -> None:
    """The distance at a pixel is that of the pixel's direction in the upright world."""
    up = np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
    found = predicted(many_view_network(Ball()), up=up).pixels().numpy()
    heights = equirect_directions(SHAPE) @ up
    highest, lowest = found[heights > 0.999].mean(), found[heights < -0.999].mean()
    upward, downward = (
        float(ball_distance(torch.tensor([0.0, 0, z], dtype=torch.float64))) for z in (1, -1)
    )
    np.testing.assert_allclose([highest, lowest], [upward, downward], rtol=0.01)


def test_cameras_are_those_of_the_grid() -> None:
    """Rotations have determinant 1, and K is that of a photo of the same field of view."""
    built: Any = build_from_config(VIEWS["horizontal"], "representation")
    views: PinholeViews = built.view_sets()[0]
    rotation, matrix = cameras_of_rays(torch.from_numpy(views.rays()), (192, 320))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(views)))
    fov = np.degrees(2 * np.arctan(views.grid.half_size[0]))
    np.testing.assert_allclose(matrix[0], camera_matrix_from_fov(fov, (192, 320)), rtol=1e-5)
    forward = rotation[:, :, 2].numpy() * (1, -1, 1)
    np.testing.assert_allclose(forward, views.grid.centers_xyz, atol=1e-6)


def test_the_error_of_rotations_ignores_the_axes_of_the_world() -> None:
    known = torch.stack(
        [torch.from_numpy(rotation_about((0, 0, 1), angle)).float() for angle in range(5)]
    )
    world = torch.from_numpy(rotation_about((1, 1, 0), 2.0)).float()
    assert rotation_error_deg(world @ known, known) < 1e-3
    wrong = known.clone()
    for k, sign in ((1, 1), (3, -1)):  # opposite errors leave the best axes as they are
        axis = rotation_about((0, 0, 1), sign * np.radians(10))
        wrong[k] = torch.from_numpy(axis).float() @ known[k]
    assert rotation_error_deg(world @ wrong, known) == pytest.approx(4, rel=1e-3)


@pytest.mark.parametrize("blend", ["feather", "nearest"])
def test_confidence_weighs_the_blend(blend: Any) -> None:
    """Compared with weighted sums; a confidence of 0 is unknown, and only ratios count."""
    views, shape = PinholeViews(TangentGrid(0, 6, 80)), (64, 128)
    generator = torch.Generator().manual_seed(0)
    distance, weight = torch.rand(2, 20, 1, 1, 1, generator=generator).expand(2, 20, 1, 80, 80)
    distance, weight = distance + 1, weight * 1e4 + 1

    def blended(*channels: Tensor) -> NDArray[np.float32]:
        mosaic = AlignedMosaic(shape, "metric_distance", blend, "none")
        mosaic.add(torch.cat(channels, dim=1), views)
        found: NDArray[np.float32] = mosaic.pixels().numpy()
        return found

    sums: Any = tangent_to_equirect(
        torch.cat([weight * distance.log(), weight], dim=1), views.grid, shape, blend
    )
    found = blended(distance, weight)
    np.testing.assert_allclose(found, (sums[0] / sums[1]).exp(), rtol=1e-5)
    plain = blended(distance)
    assert (np.abs(np.log(found / plain)).max() > 0.1) == (blend == "feather")
    np.testing.assert_allclose(blended(distance, 0 * distance + 7), plain, rtol=1e-5)
    weight[3] = 0
    unknown = np.isnan(blended(distance, weight))
    assert (unknown == ((views.owners(shape) == 3) & (blend == "nearest"))).mean() > 0.99


class Points(Ball):
    """Points of the room up to a scale and a shift of z for each view, with the channels last."""

    def forward(self, images: Tensor, world_from_camera: Tensor, camera_matrix: Tensor) -> Any:
        z = super().forward(images, world_from_camera, camera_matrix)["out"]
        rows, columns = (torch.arange(n).float() for n in images.shape[-2:])
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        rays = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ camera_matrix.inverse().mT[:, None]
        generator = torch.Generator().manual_seed(0)
        scale, shift = torch.rand(2, len(images), 1, 1, generator=generator)
        points = (0.5 + scale)[..., None] * z[..., None] * rays
        points[..., 2] += shift - 0.5
        return points


def test_points_become_distances_up_to_a_factor() -> None:
    loaded = replace(many_view_network(Points(), "horizontal"), depth_kind="relative_points")
    found = predicted(loaded, align=None).pixels().numpy()
    ratio = found / true_distances()
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=1e-3)
    assert np.median(ratio) != pytest.approx(1, abs=0.05)


def test_views_without_cameras_are_refused() -> None:
    loaded = many_view_network(Ball())
    photo = InputImage(
        np.zeros((40, 60, 3), np.uint8), camera_matrix=camera_matrix_from_fov(60, (40, 60))
    )
    erp = trained_network(ERP, module=Ball(), class_names=(), depth_kind="metric_z")
    for network, image in ((loaded, photo), (erp, InputImage(np.zeros((*SHAPE, 3), np.uint8)))):
        selector = ViewSelector(network)
        with pytest.raises(
            SettingError, match="views: found views without cameras; expected a pan"
        ):
            Predictor(network, head_of(network), selector).predict(image)


def test_the_documented_network_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adapter of VGGT in docs/how-to/own_network.md, with a stand-in that sees the room.

    Like VGGT, it returns camera-from-world in the axes of its first camera, and depth in a unit of
    its own.
    """
    known: list[Tensor] = []

    class StandIn(Ball):
        def forward(self, images: Tensor, *_: Any) -> Any:
            assert images.ndim == 5
            depth = 5 * super().forward(images[0], *known)["out"][None]
            pose = (known[0][:1].mT @ known[0]).mT[None]
            return {"depth": depth[..., None], "depth_conf": depth, "pose_enc": pose}

    def decoded(pose: Tensor, size: Any) -> tuple[Tensor, None]:
        assert tuple(size) == (128, 128)
        return torch.cat([pose, torch.zeros_like(pose[..., :1])], dim=-1), None

    page = (Path(__file__).parents[2] / "docs/how-to/own_network.md").read_text()
    code = page.partition("# my_depth.py\n")[2].partition("```")[0]
    for name, content in (
        ("vggt.models.vggt", {"VGGT": StandIn}),
        ("vggt.utils.pose_enc", {"pose_encoding_to_extri_intri": decoded}),
    ):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    names: dict[str, Any] = {}
    exec(code, names)
    adapter = names["VggtDepth"]()
    adapter.register_forward_pre_hook(lambda _, inputs: known.__setitem__(slice(None), inputs[1:]))
    loaded = replace(many_view_network(adapter), depth_kind="relative_z")
    mosaic = predicted(loaded)
    ratio = mosaic.pixels().numpy() / true_distances()
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=1e-4)
    assert float(mosaic.facts["rotation_error_deg"]) < 1e-2


@pytest.mark.parametrize("tilt_deg", [0, 25, 140])
def test_rays_of_a_tilted_panorama_point_where_its_pixels_are_in_the_world(tilt_deg: int) -> None:
    """Tilted about y; the directions of pixels come from a rendered picture of directions."""
    sine, cosine = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    views = TangentRepresentation(0, 5, random_rotation="so3").sample(np.random.default_rng(2))
    (rays,) = upright_rays([views], upright_rotation([sine, 0, cosine]), "cpu")
    ahead, right, up = np.moveaxis(
        views.render(equirect_directions((256, 512)).astype(np.float32), "bilinear"), -1, 0
    )
    expected = np.stack([ahead * cosine - up * sine, right, ahead * sine + up * cosine], -1)
    places = (2 * np.arange(32) + 1) / 32 - 1
    plane = np.stack([*np.meshgrid(places, places), np.ones((32, 32))], -1)
    found = np.einsum("nij,hwj->nhwi", np.asarray(rays), plane)
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    np.testing.assert_allclose(found, expected, atol=2e-3)
