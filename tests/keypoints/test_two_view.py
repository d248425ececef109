"""The motion between two panoramas: known motions, an eight-point reference, COLMAP's answer."""

from __future__ import annotations

import importlib.util
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import PanoramaPose, rotation_about
from tangent_train.keypoints.motion_search import CAMERA_FROM_PANORAMA
from tangent_train.keypoints.two_view import TwoView, estimate_two_view
from tests.keypoints.scenes import Scene, angle_deg, rotation_angle_deg, two_views, unit

HERE = PanoramaPose(np.eye(3), np.zeros(3))
needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed"
)


def estimated(scene: Scene, **settings: float) -> TwoView:
    return estimate_two_view(scene.left_xyz, scene.right_xyz, **settings)  # type: ignore[arg-type]


def differences(found: TwoView, scene: Scene) -> tuple[float, float]:
    assert found.rotation is not None
    turn = rotation_angle_deg(found.rotation, scene.rotation)
    if found.translation is None:
        return turn, float("nan")
    return turn, float(angle_deg(found.translation, scene.translation_m))


@needs_pycolmap
@pytest.mark.parametrize("seed", range(4))
def test_exact_matches_give_the_exact_motion(seed: int) -> None:
    scene = two_views(100, seed=seed)
    found = estimated(scene)
    turn, shift = differences(found, scene)
    assert found.kind == "general"
    assert turn < 1e-4
    assert shift < 1e-3
    assert found.inliers.all()
    assert found.errors_deg.max() < 1e-3


@needs_pycolmap
@pytest.mark.parametrize(("wrong", "seed"), [(0, 1), (300, 2), (420, 3), (480, 4)])
def test_noise_and_wrong_matches(wrong: int, seed: int) -> None:
    scene = two_views(600, wrong=wrong, noise_deg=0.1, seed=seed)
    found = estimated(scene)
    turn, shift = differences(found, scene)
    assert found.kind == "general"
    assert turn < 0.15
    assert shift < 1.5
    right = np.arange(600) >= wrong
    assert found.inliers[right].mean() > 0.99
    # By chance a wrong one lies in the band of a ray: 2° · 90° of 41 253 square degrees.
    assert found.inliers[~right].sum() <= 0.02 * wrong + 2
    np.testing.assert_array_equal(found.inliers, found.errors_deg <= 1)


@needs_pycolmap
@pytest.mark.parametrize("seed", range(3))
def test_a_floor_alone_gives_a_motion(seed: int) -> None:
    scene = two_views(300, wrong=100, noise_deg=0.05, flat=True, seed=seed)
    found = estimated(scene)
    assert found.kind == "general"
    assert found.inliers[100:].mean() > 0.98
    if seed < 2:  # the points of a plane may fit a second motion as well (Longuet-Higgins 1986)
        turn, shift = differences(found, scene)
        assert turn < 0.5
        assert shift < 3


@needs_pycolmap
@pytest.mark.parametrize(("noise_deg", "seed"), [(0.0, 0), (0.05, 1), (0.3, 2)])
def test_two_panoramas_of_one_place_differ_by_a_rotation(noise_deg: float, seed: int) -> None:
    scene = two_views(400, baseline_m=0, wrong=200, noise_deg=noise_deg, seed=seed)
    found = estimated(scene)
    turn, _ = differences(found, scene)
    assert found.kind == "rotation"
    assert found.translation is None
    assert found.essential is None
    assert turn < 0.02 + 0.2 * noise_deg
    apart = angle_deg(scene.left_xyz @ scene.rotation.T, scene.right_xyz)
    np.testing.assert_allclose(found.errors_deg, apart, atol=0.02 + 0.2 * noise_deg)
    assert found.inliers[200:].mean() > (apart[200:] <= 1).mean() - 0.02
    assert found.inliers[:200].sum() <= 1  # a cap of 1° is 1/13000 of the sphere


@needs_pycolmap
def test_a_short_baseline_is_seen_where_matches_are_precise() -> None:
    # 2 cm in a room: points move by up to 0.8°, less than max_error_deg.
    scene = two_views(500, baseline_m=0.02, noise_deg=0.02, seed=5)
    found = estimated(scene)
    turn, shift = differences(found, scene)
    assert found.kind == "general"
    assert turn < 0.05
    assert shift < 5


@needs_pycolmap
def test_the_rotation_of_an_eight_point_reference() -> None:
    scene = two_views(200, noise_deg=0.01, seed=6)
    found = estimated(scene)
    essential = eight_point(scene.left_xyz, scene.right_xyz)
    assert found.essential is not None
    ours = found.essential / np.linalg.norm(found.essential)
    assert min(np.abs(ours - essential).max(), np.abs(ours + essential).max()) < 2e-3
    residuals = np.einsum("mi,ij,mj->m", scene.right_xyz, found.essential, scene.left_xyz)
    assert np.abs(residuals).max() < 1e-3


def eight_point(left: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hartley's linear method on bearing vectors, with equal singular values, of norm 1."""
    rows = np.einsum("mi,mj->mij", right, left).reshape(-1, 9)
    u, s, vt = np.linalg.svd(np.linalg.svd(rows)[2][-1].reshape(3, 3))
    matrix: NDArray[np.float64] = u @ np.diag([s[:2].mean(), s[:2].mean(), 0]) @ vt
    return matrix / np.linalg.norm(matrix)


@needs_pycolmap
def test_colmaps_two_view_geometry_agrees() -> None:
    import pycolmap

    scene = two_views(400, wrong=160, noise_deg=0.05, seed=7)
    camera = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 1024, 512)
    pixels = [camera.img_from_cam(xyz @ CAMERA_FROM_PANORAMA.T) for xyz in scene[:2]]
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = 1024 / 360
    options.ransac.random_seed = 0
    options.compute_relative_pose = True
    options.detect_watermark = False
    matches = np.repeat(np.arange(400, dtype=np.uint32)[:, None], 2, axis=1)
    theirs = pycolmap.estimate_calibrated_two_view_geometry(
        camera, pixels[0], camera, pixels[1], matches, options
    )
    found = estimated(scene)
    axes = CAMERA_FROM_PANORAMA
    turn = axes.T @ theirs.cam2_from_cam1.rotation.matrix() @ axes
    assert rotation_angle_deg(found.rotation, turn) < 0.05  # type: ignore[arg-type]
    shift = axes.T @ theirs.cam2_from_cam1.translation
    assert angle_deg(found.translation, shift) < 1  # type: ignore[arg-type]
    inliers = np.zeros(400, np.bool_)
    inliers[np.asarray(theirs.inlier_matches)[:, 0]] = True
    assert (inliers == found.inliers).mean() > 0.97


@needs_pycolmap
def test_colmaps_panorama_is_ours() -> None:
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 1024, 512)
    ours = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [-1, -1e-9, 0]])
    pixels = camera.img_from_cam(ours @ CAMERA_FROM_PANORAMA.T)
    # Corner-origin pixels: the middle of the image is (512, 256).
    expected = [(512, 256), (768, 256), (256, 256), (512, 0), (512, 512), (0, 256)]
    np.testing.assert_allclose(pixels, expected, atol=1e-5)


@needs_pycolmap
@pytest.mark.parametrize("count", [0, 1, 4, 5, 7])
def test_too_few_matches_have_no_motion(count: int) -> None:
    found = estimated(two_views(count))
    assert found.kind == "none"
    assert found.inliers.shape == found.errors_deg.shape == (count,)
    assert not found.inliers.any()
    assert np.isnan(found.errors_deg).all()
    assert found.rotation is found.translation is found.essential is None
    assert found.right_pose(HERE) is None
    assert np.isnan(found.pose_error_deg(HERE, HERE)).all()


@needs_pycolmap
def test_few_good_matches_are_enough() -> None:
    scene = two_views(8, seed=8)
    assert estimated(scene).inliers.all()
    fewer = scene._replace(left_xyz=scene.left_xyz[:6], right_xyz=scene.right_xyz[:6])
    assert estimated(fewer).kind == "none"
    assert estimated(fewer, min_inliers=6).inliers.all()


@needs_pycolmap
@pytest.mark.parametrize(("count", "seed"), [(30, 0), (200, 1), (1000, 2)])
def test_wrong_matches_alone_have_no_motion(count: int, seed: int) -> None:
    scene = two_views(count, wrong=count, seed=seed)
    found = estimated(scene, max_trials=5000)
    assert found.kind == "none"
    assert found.inliers.sum() == 0


@needs_pycolmap
@pytest.mark.parametrize("places", [1, 2, 3])
def test_matches_of_few_places_do_no_harm(places: int) -> None:
    rays = unit(np.random.default_rng(3).normal(size=(places, 3)))
    left = np.tile(rays, (40, 1))
    found = estimate_two_view(left, left @ rotation_about((1, 2, 3), 0.5).T)
    if found.rotation is not None:
        turned = rays @ rotation_about((1, 2, 3), 0.5).T
        np.testing.assert_allclose(angle_deg(rays @ found.rotation.T, turned), 0, atol=0.5)
    assert np.isfinite(found.errors_deg).all() or found.kind == "none"


@needs_pycolmap
def test_the_same_seed_gives_the_same_motion_in_any_thread() -> None:
    scene = two_views(300, wrong=200, noise_deg=0.2, seed=9)
    with ThreadPoolExecutor(3) as pool:
        runs = list(pool.map(lambda seed: estimated(scene, seed=seed), [0, 1, 0, 1]))
    for first, second in (runs[0::2], runs[1::2]):
        np.testing.assert_array_equal(first.errors_deg, second.errors_deg)
        np.testing.assert_array_equal(first.essential, second.essential)
    assert differences(runs[1], scene)[0] < 0.5


@needs_pycolmap
def test_turning_the_right_panorama_turns_the_motion() -> None:
    scene = two_views(300, wrong=150, noise_deg=0.1, seed=10)
    turn = rotation_about((0.3, -1, 0.5), 2.0)
    first = estimated(scene)
    second = estimate_two_view(scene.left_xyz, scene.right_xyz @ turn.T)
    assert rotation_angle_deg(second.rotation, turn @ first.rotation) < 0.1  # type: ignore[arg-type, operator]
    assert (first.inliers == second.inliers).mean() > 0.98


@needs_pycolmap
def test_lengths_of_directions_mean_nothing() -> None:
    scene = two_views(50, seed=11)
    stretched = estimate_two_view(scene.left_xyz * 3, scene.right_xyz * 0.1)
    assert stretched.inliers.all()


@needs_pycolmap
def test_poses_of_the_right_panorama() -> None:
    scene = two_views(300, baseline_m=0.7, noise_deg=0.02, seed=12)
    found = estimated(scene)
    pose = found.right_pose(scene.left, baseline_m=0.7)
    assert pose is not None
    assert np.linalg.norm(pose.location_m - scene.right.location_m) < 0.01
    turn = pose.world_from_panorama.T @ scene.right.world_from_panorama
    assert rotation_angle_deg(turn, np.eye(3)) < 0.1
    expected = differences(found, scene)
    errors = found.pose_error_deg(scene.left, scene.right)
    np.testing.assert_allclose(errors, expected, rtol=1e-3, atol=1e-6)


def test_errors_of_poses_are_angles() -> None:
    turn = rotation_about((1, 1, 0), np.radians(12))
    t = np.array([0, 0, -1.0])
    found = TwoView("general", np.ones(9, np.bool_), np.zeros(9), turn, t)
    right = HERE.moved(np.eye(3), 3 * rotation_about((1, 0, 0), np.radians(5)) @ t)
    np.testing.assert_allclose(found.pose_error_deg(HERE, right), (12, 5), atol=1e-9)
    # The left centre is straight below the right one, by the right one's axes.
    right_again = found.right_pose(HERE, baseline_m=2)
    assert right_again is not None
    np.testing.assert_allclose(right_again.location_m, turn.T @ (0, 0, 2))
    turn_deg, shift_deg = found.pose_error_deg(HERE, HERE)
    assert turn_deg == pytest.approx(12)
    assert np.isnan(shift_deg)


def test_a_rotation_keeps_the_place() -> None:
    turn = rotation_about((1, 1, 0), np.radians(12))
    found = TwoView("rotation", np.ones(9, np.bool_), np.zeros(9), turn, None)
    pose = found.right_pose(PanoramaPose(np.eye(3), (1, 2, 3)))
    assert pose is not None
    np.testing.assert_array_equal(pose.location_m, (1, 2, 3))
    np.testing.assert_allclose(pose.world_from_panorama, turn.T)


@pytest.mark.parametrize(
    ("left", "right", "settings", "message"),
    [
        (np.ones((9, 3)), np.ones((8, 3)), {}, "found 9 and 8; expected as many"),
        (np.ones((9, 2)), np.ones((9, 2)), {}, r"\(9, 2\)"),
        (np.zeros((9, 3)), np.ones((9, 3)), {}, "0 or no numbers"),
        (np.ones((9, 3)), np.full((9, 3), np.nan), {}, "0 or no numbers"),
        (np.ones((9, 3)), np.ones((9, 3)), {"max_error_deg": 0}, "max_error_deg: found 0"),
        (np.ones((9, 3)), np.ones((9, 3)), {"max_error_deg": 30}, "at most 20"),
        (np.ones((9, 3)), np.ones((9, 3)), {"seed": -1}, "seed: found -1"),
        (np.ones((9, 3)), np.ones((9, 3)), {"min_inliers": 5}, "6 or more"),
        (np.ones((9, 3)), np.ones((9, 3)), {"max_trials": 0}, "1 or more"),
    ],
)
def test_what_cannot_be_estimated(
    left: NDArray[np.float64],
    right: NDArray[np.float64],
    settings: dict[str, int],
    message: str,
) -> None:
    with pytest.raises(SettingError, match=message):
        estimate_two_view(left, right, **settings)


def test_a_missing_pycolmap_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    scene = two_views(20)
    with pytest.raises(SettingError, match=r"pip install 'tangent-train\[keypoints\]'"):
        estimated(scene)
    assert estimated(two_views(3)).kind == "none"  # nothing to look for
