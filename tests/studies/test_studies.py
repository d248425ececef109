"""The studies of distortion, against closed forms, the paper and ``docs/results/data``."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from studies.angular_resolution import angular_resolution
from studies.constant_depth import constants
from studies.depth_alignment import depth_alignment
from studies.distorted_digits import BODY, distort, enlarge, mean_enlargement, pixel_centers
from studies.fov import fov
from studies.measures import MEASURES, closed_forms
from studies.methods import KINDS, picture, table
from studies.output import markdown
from studies.point_views import SIDE, drawn, titled
from studies.representation_distortion import representation_distortion
from studies.rotation_error import icosahedral_rotations, mean_error
from studies.strips import write_strips
from studies.surface_area import surface_area
from studies.trained_objects import Centers, connected_parts
from studies.transfer import STAGES
from studies.transfer import picture as picture_of_transfer
from studies.transfer import table as table_of_transfer
from tangent_train.geometry import equirect_directions, random_rotation
from tangent_train.geometry.icosphere import icosphere_directions
from tangent_train.rendering import IcosphereRepresentation
from tests.datamodules.zind_format import write_homes

DOCS = Path(__file__).resolve().parents[2] / "docs"
DATA = DOCS / "results" / "data"


def test_the_documentation_has_the_tables() -> None:
    """Figures of the paper are beside those of this project."""
    tables = {
        "fov": fov(), "surface_area": surface_area(6), "angular_resolution": angular_resolution()
    }  # fmt: skip
    for name, rows in tables.items():
        published = (DATA / f"distortion_{name}.csv").read_text(encoding="utf-8").splitlines()
        header, _, *lines = markdown(rows).splitlines()
        for line in (header, *lines):
            assert line.strip("| ").replace(" | ", ",") in published


def test_distortions_agree_with_closed_forms() -> None:
    distortions = {row["images"]: row for row in representation_distortion((128, 256))}
    erp, cube, first = (distortions[name] for name in ("ERP", "cube", "b = 0"))
    gamma = math.gamma
    beta = math.sqrt(math.pi) / 2 * (gamma(0.25) / gamma(0.75) - gamma(0.75) / gamma(1.25))
    assert erp["angle mean °"] == pytest.approx(math.degrees(math.pi - 2 * beta), rel=1e-3)
    middle = math.acos(2 / math.pi)
    assert erp["area mean %"] == pytest.approx(
        200 * (math.sin(middle) - 2 * middle / math.pi), rel=1e-3
    )
    # The corners of a cube are at cos θ = 1/√3: scales 3 and √3; mean scale of areas 24/4π.
    corner = math.degrees(2 * math.asin((3 - math.sqrt(3)) / (3 + math.sqrt(3))))
    assert cube["angle worst °"] == pytest.approx(corner)
    assert cube["area most"] == pytest.approx(math.sqrt(3) * math.pi / 2, rel=1e-3)
    # The icosahedron's vertices are 37.377° from the centers of its faces: 2 asin(tan²(θ/2)).
    angle = math.acos(math.sqrt((5 + 2 * math.sqrt(5)) / 15))
    assert first["angle worst °"] == pytest.approx(
        math.degrees(2 * math.asin(math.tan(angle / 2) ** 2))
    )
    means = [row["angle mean °"] for row in distortions.values()]
    assert means == sorted(means, reverse=True)


@pytest.mark.parametrize("k1", [0.0, 0.13, 0.5])
def test_the_lens_agrees_with_a_slow_sampler(k1: float) -> None:
    side = 7
    image = np.random.default_rng(3).random((side, side))
    expected = np.zeros((side, side))
    for i, j in np.ndindex(side, side):
        x, y = (2 * j + 1) / side - 1, (2 * i + 1) / side - 1
        radius = math.hypot(x, y)
        true = brentq(lambda r, at=radius: r + k1 * r**3 - at, 0, 2, xtol=1e-14)
        scale = true / radius if radius else 1.0
        u, v = (x * scale + 1) * side / 2 - 0.5, (y * scale + 1) * side / 2 - 0.5
        across = np.maximum(0, 1 - abs(u - np.arange(side)))
        expected[i, j] = np.maximum(0, 1 - abs(v - np.arange(side))) @ image @ across
    found = distort(torch.from_numpy(image)[None, None], k1)
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-9)


def test_enlargement_is_the_mean_enlargement_of_the_lens() -> None:
    points = pixel_centers(torch.zeros(1, 1, 560, 560))
    body = points[points.abs().amax(dim=-1) < BODY]
    expected = float((1 + 0.5 * body.square().sum(dim=-1)).mean())
    assert mean_enlargement(0.5) == pytest.approx(expected, rel=1e-4)
    dot = torch.zeros(1, 1, 57, 57)
    dot[0, 0, 28, 48] = 1
    columns = enlarge(dot, 0.5)[0, 0].sum(dim=0)
    found = float(columns @ torch.arange(57.0) / columns.sum())
    assert found - 28 == pytest.approx(20 * mean_enlargement(0.5), abs=0.1)


def test_rotation_errors_are_those_of_the_network() -> None:
    """A network of pixels is equivariant; one that returns the height z has a closed form."""
    representation, group = IcosphereRepresentation(3), icosahedral_rotations()
    traces = np.sort(np.einsum("nij,mij->nm", group, group))
    assert (abs(traces[:, -2:] - [1 + 2 * math.cos(math.radians(72)), 3]) < 1e-9).all()
    pointwise = torch.nn.Conv2d(4, 3, 1)
    assert mean_error(pointwise, representation, group[:9], by_cells=True) < 1e-3
    rotations = np.stack([random_rotation(np.random.default_rng(5)), np.eye(3)])
    assert 0.1 < mean_error(pointwise, representation, rotations[:1]) < 10
    assert mean_error(pointwise, representation, rotations[1:]) < 1e-3

    height = torch.tensor(icosphere_directions(3)[:, 2], dtype=torch.float32)

    def fixed(x: torch.Tensor) -> torch.Tensor:
        scores = torch.stack([torch.zeros_like(height), height / 1e3])
        return scores[None, :, None].expand(len(x), -1, -1, -1)

    # The probabilities are linear in z: the difference of Rz and z is √(2 − 2 R_zz) as large.
    expected = np.sqrt(2 - 2 * group[:, 2, 2].clip(max=1)).mean()
    found = mean_error(fixed, representation, group, by_cells=True)  # type: ignore[arg-type]
    assert found == pytest.approx(100 * expected, rel=1e-3)


def test_the_chart_of_methods_names_every_method_once() -> None:
    names = [*table("prior_methods_step")]
    for axes in picture().axes:
        assert sorted(text.get_text() for text in axes.texts) == sorted(names)
    (legend,) = picture().legends
    assert [text.get_text() for text in legend.get_texts()] == [*KINDS]


def test_constant_depths_minimize_their_errors() -> None:
    steps = np.random.default_rng(0).integers(0, 3000, (3, 8, 5)).astype(np.int32)
    found = constants(steps)
    known = steps[steps > 0] / 512

    def absrel(guess: float) -> float:
        return float((abs(guess - known) / known).mean())

    assert found["smallest AbsRel"].shape == (1, 1)
    assert absrel(float(found["smallest AbsRel"][0, 0])) == pytest.approx(
        min(absrel(guess) for guess in known)
    )
    assert found["median"][0, 0] == pytest.approx(np.median(known))
    row = steps[:, 3][steps[:, 3] > 0] / 512
    assert found["median of the row"].shape == (8, 1)
    assert found["median of the row"][3, 0] == pytest.approx(np.median(row))


def test_rows_of_points_are_below_their_titles() -> None:
    row = np.full((SIDE, 3 * SIDE, 3), 255, np.uint8)
    row[100:150, 200:300] = 9
    picture = titled({"true": row, "predicted": row})
    assert picture.shape == (2 * (56 + 50 + 16), 3 * SIDE, 3)
    np.testing.assert_array_equal(picture[56:106], row[100:150])


def test_the_chart_of_a_transfer_has_all_stages() -> None:
    means, bands = picture_of_transfer().axes
    assert {text.get_text() for text in means.get_yticklabels()} == {*STAGES.values()}
    assert STAGES.keys() == {row["stage"] for row in table_of_transfer("transfer")}
    assert len(bands.lines) == 5


def test_points_are_drawn_from_three_sides() -> None:
    """A red wall 2 m ahead is at the top of the floor plan, and right in a view to the left."""
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 99), np.linspace(-0.5, 0.5, 99))
    wall = np.stack([np.full(y.size, 2.0), y.ravel(), z.ravel()], axis=-1)
    hidden = wall * (2, 1, 1)  # behind it, from the camera
    colors = np.repeat(np.array([[255, 0, 0], [0, 255, 0]], np.uint8), y.size, axis=0)
    views = drawn(np.concatenate([wall, hidden]), colors, 5).reshape(SIDE, 3, SIDE, 3)
    red, green = ((views == color).all(axis=-1) for color in ([255, 0, 0], [0, 255, 0]))
    plan, ahead, left = (np.argwhere(red[:, k]).mean(axis=0) for k in range(3))
    assert plan == pytest.approx([SIDE * (1 - 2 / 5) / 2, SIDE / 2], abs=1)
    assert ahead == pytest.approx([SIDE / 2, SIDE / 2], abs=1)
    assert left == pytest.approx([SIDE / 2, SIDE * (1 + 2 / 5) / 2], abs=1)
    assert not green[:, 1].any()
    assert green[:, 2].any()


def test_scales_of_a_box_are_recovered_and_smooth_errors_reduced_by_a_grid() -> None:
    distance_m = 2 / np.abs(equirect_directions((64, 128)) / (1, 1.5, 0.7)).max(axis=-1)
    exact, smooth = (depth_alignment(distance_m, "metric_z", error, dim=64) for error in (0, 0.1))
    assert exact["step before"] > 50
    assert exact["view"] < 0.5
    assert smooth["error"] > 5
    noisy = depth_alignment(
        distance_m, "metric_z", 0, dim=64, pixel_noise=0.1, modes=[None], seed=1
    )
    assert noisy["view"] < 2
    assert smooth["error, grid"] < smooth["error"] / 2


def test_strips_are_a_data_set_of_the_horizon(tmp_path: Path) -> None:
    write_homes(tmp_path / "homes", rows=128)
    write_strips(tmp_path / "homes", tmp_path / "strips")
    names = (tmp_path / "strips" / "test.txt").read_text().splitlines()
    assert names
    for name in names:
        for folder in ("images", "labels"):
            image = cv2.imread(str(tmp_path / "strips" / folder / f"{name}.png"), 0)
            assert image is not None
            assert image.shape == (50, 256)


def test_the_measures_of_known_predictions_are_on_their_page() -> None:
    page = (DOCS / "explanation" / "measures.md").read_text(encoding="utf-8")
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()]
    rows = {str(row["prediction"]): row for row in closed_forms()}
    for name, row in rows.items():
        cells = [f"{row[m]:.1f}" if row[m] != "" else "" for m in MEASURES]
        assert [name, *(c.replace("-0.0", "0.0").replace("-", "−") for c in cells)] in lines
    cap, shift = 1 - math.cos(math.radians(30)), 3 / 1024 * 180  # three rows
    ious = {
        "class 1 within 30° of the poles": (1 / (1 + cap) + 1 - cap) / 2,
        "class 1 in 9° east of the seam": (180 / 189 + 171 / 180) / 2,
        "a boundary off by 0.5°": 1 - math.sin(math.radians(shift)),
    }
    for name, iou in ious.items():
        assert rows[name]["miou_solid_angle"] == pytest.approx(100 * iou, abs=0.1)
    assert rows["a boundary off by 0.5°"]["boundary_miou"] == pytest.approx(100 / 3, abs=0.01)
    west = rows["class 1 in 9° east of the seam"]
    assert (west["seam_step"], west["seam_gap"]) == pytest.approx((100 - 100 / 2047, -25))
    ramp = rows["distances that grow from 1 m to 2 m"]
    assert ramp["seam_step"] == pytest.approx(100 * math.log(2) * (1 - 2 / 2048))


def test_centers_separate_objects_that_touch() -> None:
    """Two chairs (label 5) and a sofa (10) side by side, with perfect maps."""
    codes = torch.full((64, 64), 12 * 65536)
    areas = {5 * 65536 + 7: (0, 20), 5 * 65536 + 8: (20, 40), 10 * 65536 + 9: (40, 64)}
    heat, offsets = torch.zeros(64, 64), torch.zeros(2, 64, 64)
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    for code, (left, right) in areas.items():
        codes[10:50, left:right] = code
        center = 30, (left + right) // 2
        heat[center] = 1
        offsets[0, 10:50, left:right] = (center[0] - rows)[10:50, left:right].float()
        offsets[1, 10:50, left:right] = (center[1] - columns)[10:50, left:right].float()
    shares = torch.nn.functional.one_hot(codes // 65536 - 1, 13).permute(2, 0, 1).float()
    network = Centers()
    found = network.segments(shares, heat, offsets)
    assert sorted(found.classes.tolist()) == [4, 4, 9]
    parts = [connected_parts(network, shares).numbers, found.numbers]
    for code in areas:
        whole = codes == code
        assert [torch.equal(n == n[whole][0], whole) for n in parts] == [code > 6 * 65536, True]
