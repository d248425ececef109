"""One pair, compared in several ways, in a room where everything is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datamodules.core.panorama_pairs import ImagePairs, PanoramaPair
from tangent_train.errors import SettingError
from tangent_train.geometry.coverage import is_valid
from tangent_train.geometry.sphere import area_mask
from tangent_train.keypoints.compare import AS_GIVEN, CUBE, ROTATED, SHRUNK, Comparer
from tests.datamodules.data_files import GPANO_TAGS, gpano_xmp
from tests.keypoints.ball_room import ball_pair

pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def pair() -> PanoramaPair:
    return ball_pair()


def test_figures_are_those_of_the_counts_and_of_the_truth(pair: PanoramaPair) -> None:
    comparison = Comparer((1,), margin=16, seed=3).compare(pair)
    assert [(row["condition"], row["representation"]) for row in comparison.rows] == [
        (condition, name)
        for condition in (AS_GIVEN, ROTATED)
        for name in ("ERP", SHRUNK, CUBE, "L1")
    ]
    for row in comparison.rows:
        named = (row["pair"], row["left"], row["right"], row["level"])
        assert named == ("ball", "ball_l", "ball_r", 7)
        # Nothing is hidden in a ball.
        assert row["fov_overlap"] == pytest.approx(1.0, abs=1e-3)
        assert row["visible_by"] == "depth"
        assert row["visible_left"] == row["keypoints_left"] > 50
        assert row["visible_right"] == row["keypoints_right"] > 50
        p, f, n_left, n_right = (
            row[k] for k in ("putative", "inliers", "visible_left", "visible_right")
        )
        assert row["pmr"] == pytest.approx((p / n_left + p / n_right) / 2)
        assert row["ms"] == pytest.approx((f / n_left + f / n_right) / 2)
        assert row["p"] == pytest.approx(f / p)
        found = comparison.matched[row["condition"]][row["representation"]]
        assert (len(found.matches), int(found.geometry.inliers.sum())) == (p, f)
        assert (row["geometry"], row["verifiable"]) == ("general", p)
        assert row["rotation_error_deg"] < 1
        assert row["translation_error_deg"] < 5
        # The recall of one pair is 0 up to its error, and 1 beyond.
        worst = max(row["rotation_error_deg"], row["translation_error_deg"])
        recall = np.linspace(0, 10, 10_001) >= worst
        assert row["pose_auc_10"] == pytest.approx(recall.mean(), abs=1e-3)
        assert row["pose_auc_5"] < row["pose_auc_10"] < row["pose_auc_20"] < 1
        # Inliers by the estimate and by the truth are nearly the same matches.
        assert row["correct_share"] == row["correct"] / row["verifiable"]
        assert abs(row["correct_share"] - row["p"]) < 0.1


def test_without_depth_all_keypoints_count_and_blank_panoramas_have_no_scores(
    pair: PanoramaPair,
) -> None:
    blank = pair.left._replace(rgb=np.full((64, 128, 3), 90, np.uint8), distance_m=None)
    comparer = Comparer((0,), controls=False)
    for other in (pair.right, blank):
        for row in comparer.compare(PanoramaPair("x", None, other, blank)).rows:
            assert (row["fov_overlap"], row["visible_by"]) == (None, "all keypoints")
            assert row["visible_left"] == row["keypoints_left"]
            assert (row["verifiable"], row["rotation_error_deg"]) == (None, None)
            assert (row["putative"], row["geometry"]) == (0, "none")
            assert row["pose_auc_20"] is None
            assert row["pmr"] is row["ms"] is row["p"] is None
    with pytest.raises(SettingError, match="level: found 8; expected 7 or less for ball"):
        Comparer((0,), level=8).compare(pair)


def test_keypoints_of_partial_panoramas_lie_in_their_areas(
    pair: PanoramaPair, tmp_path: Path
) -> None:
    """Rotated or not, read from files that repeat their edges outside."""
    files = []
    for name, side in (("left", pair.left), ("right", pair.right)):
        xmp = gpano_xmp(
            GPANO_TAGS
            | {"FullPanoWidthPixels": 384, "FullPanoHeightPixels": 192, "CroppedAreaTopPixels": 40}
            | {"CroppedAreaLeftPixels": 100, "CroppedAreaImageWidthPixels": 200}
            | {"CroppedAreaImageHeightPixels": 120}
        )
        files.append(str(tmp_path / f"{name}.webp"))
        Image.fromarray(side.rgb[40:160, 100:300]).save(files[-1], xmp=xmp, lossless=True)
    read = ImagePairs(files[0], files[1]).read(0)
    valid = area_mask((-86.25, 101.25, -60, 52.5), (192, 384))
    assert read.left.valid is not None
    np.testing.assert_array_equal(read.left.valid, valid)
    comparison = Comparer((1,), seed=3).compare(read)
    for condition in (AS_GIVEN, ROTATED):
        for matched in comparison.matched[condition].values():
            assert len(matched.left) > 20
            assert is_valid(valid, matched.left.directions_xyz).all()
            is_inside = is_valid(valid, matched.right.directions_xyz)
            assert is_inside.all() == (condition == AS_GIVEN)
