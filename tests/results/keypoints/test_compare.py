"""One pair, compared in several ways, in a room where everything is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datamodules.core.panorama_pairs import PanoramaPair
from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, random_rotation
from tangent_train.keypoints.detectors import Detector
from tangent_train.rendering import rotate_equirect
from tangent_train.results.keypoints.compare import Comparer, Comparison, Matching
from tangent_train.results.keypoints.entries import AS_GIVEN, TURNED
from tangent_train.results.keypoints.representations import Representations, at_level
from tests.results.keypoints.ball_room import ball_pair

WAYS = Representations((0, 1), Detector("sift"), 16, shrunk=True)


@pytest.fixture(scope="module")
def pair() -> PanoramaPair:
    return ball_pair()


@pytest.fixture(scope="module")
def comparison(pair: PanoramaPair) -> Comparison:
    return Comparer(WAYS, Matching(seed=3)).compare(pair)


def test_every_way_in_every_condition(comparison: Comparison) -> None:
    entry = comparison.entry
    assert [(s.condition, s.representation) for s in entry.scored] == [
        (condition, name)
        for condition in (AS_GIVEN, TURNED)
        for name in ("ERP", "ERP_shrunk", "L0", "L1")
    ]
    assert (entry.name, entry.rows, entry.level, entry.error) == ("ball", 192, 7, None)
    assert (entry.left, entry.right) == ("ball_l", "ball_r")
    assert entry.seconds > 0


def test_nothing_is_hidden_in_a_ball(comparison: Comparison) -> None:
    assert comparison.entry.has_geometry
    assert comparison.entry.fov_overlap == pytest.approx(1.0, abs=1e-3)
    for scored in comparison.entry.scored:
        assert scored.visible_left == scored.keypoints_left > 50
        assert scored.visible_right == scored.keypoints_right > 50


def test_the_estimated_geometry_is_the_true_one(comparison: Comparison) -> None:
    for scored in comparison.entry.scored:
        assert scored.kind == "general"
        assert scored.rotation_error_deg is not None
        assert scored.translation_error_deg is not None
        assert scored.rotation_error_deg < 1
        assert scored.translation_error_deg < 5


def test_scores_are_those_of_the_counts(comparison: Comparison) -> None:
    for scored in comparison.entry.scored:
        p, f = scored.putative, scored.inliers
        n_left, n_right = scored.visible_left, scored.visible_right
        assert scored.pmr == pytest.approx((p / n_left + p / n_right) / 2)
        assert scored.ms == pytest.approx((f / n_left + f / n_right) / 2)
        assert scored.p == pytest.approx(f / p)
        found = comparison.found[scored.condition][scored.representation]
        assert (len(found.matches), int(found.geometry.inliers.sum())) == (p, f)
        assert scored.judged == p
        assert scored.correct_share is not None
        assert scored.p is not None
        # Inliers by the estimate and by the truth are nearly the same matches.
        assert abs(scored.correct_share - scored.p) < 0.1


def test_tangent_images_match_better_than_the_panorama(comparison: Comparison) -> None:
    """Both panoramas are turned any way: that is what they are for."""
    for condition in (AS_GIVEN, TURNED):
        found = comparison.entry.of_condition(condition)
        assert found["L1"].pmr is not None
        assert found["ERP"].pmr is not None
        assert found["L1"].pmr > found["ERP"].pmr


def test_the_turn_is_the_documented_one(pair: PanoramaPair, comparison: Comparison) -> None:
    turn = Matching(seed=3).turn("ball")
    image = comparison.images[TURNED][1]
    np.testing.assert_array_equal(image, rotate_equirect(pair.right.rgb, turn))
    np.testing.assert_array_equal(comparison.images[TURNED][0], pair.left.rgb)
    assert not np.allclose(Matching(seed=4).turn("ball"), turn)
    assert not np.allclose(Matching(seed=3).turn("other"), turn)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_keypoints_of_known_panoramas_are_not_looked_for_again(
    pair: PanoramaPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    true_detect = Representations.detect

    def counted(self: Representations, rgb: object, level: int, name: str) -> object:
        asked.append(name)
        return true_detect(self, rgb, level, name)  # type: ignore[arg-type]

    monkeypatch.setattr(Representations, "detect", counted)
    ways = Representations((0,), Detector("sift"), 8, shrunk=False)
    comparer = Comparer(ways, Matching(), level=5, turned=False)
    first = comparer.compare(pair)
    assert asked == ["ERP", "ERP", "L0", "L0"]
    swapped = PanoramaPair("back", None, pair.right, pair.left)
    back = comparer.compare(swapped)
    assert len(asked) == 4
    assert [s.condition for s in back.entry.scored] == [AS_GIVEN, AS_GIVEN]
    for one, other in zip(first.entry.scored, back.entry.scored, strict=True):
        assert (one.keypoints_left, one.keypoints_right) == (
            other.keypoints_right,
            other.keypoints_left,
        )


def test_without_depth_all_keypoints_count(pair: PanoramaPair) -> None:
    bare = pair._replace(right=pair.right._replace(distance_m=None))
    ways = Representations((0,), Detector("orb"), 16, shrunk=False)
    entry = Comparer(ways, Matching()).compare(bare).entry
    assert (entry.has_geometry, entry.fov_overlap) == (False, None)
    for scored in entry.scored:
        assert scored.visible_left == scored.keypoints_left > 0
        assert (scored.judged, scored.rotation_error_deg, scored.correct_share) == (None,) * 3


def test_blank_panoramas_have_undefined_scores(pair: PanoramaPair) -> None:
    blank = pair.left._replace(rgb=np.full((64, 128, 3), 90, np.uint8), distance_m=None)
    ways = Representations((0,), Detector("sift"), 16, shrunk=True)
    entry = Comparer(ways, Matching()).compare(PanoramaPair("x", None, blank, blank)).entry
    assert entry.without_keypoints == ["ball_l"]
    for scored in entry.scored:
        assert (scored.putative, scored.inliers, scored.kind) == (0, 0, "none")
        assert scored.pmr is scored.ms is scored.p is None


@pytest.mark.parametrize("base_level", [0, 3])
def test_a_base_level_too_near_to_the_level_is_refused(base_level: int) -> None:
    ways = Representations((base_level,), Detector("sift"), 16, shrunk=False)
    ways.check_level(base_level + 2)
    for level in (base_level, base_level + 1):
        message = f"base_level: found {base_level}; expected at most the level, {level}, less 2"
        with pytest.raises(SettingError, match=message):
            ways.check_level(level)
        with pytest.raises(SettingError, match="dim"):  # the grid would refuse it, too
            _ = TangentGrid(base_level, level)
    _ = TangentGrid(base_level, base_level + 2)


def test_levels_that_do_not_suit_the_panorama_are_refused(pair: PanoramaPair) -> None:
    far = replace(WAYS, base_levels=(6,))
    with pytest.raises(SettingError, match=r"level, 7, less 2\. The level is that of ball_l, 192"):
        Comparer(far, Matching()).compare(pair)
    with pytest.raises(
        SettingError, match="level: found 8; expected at most 7, that of ball_l, 192"
    ):
        Comparer(WAYS, Matching(), level=8).compare(pair)


def test_panoramas_are_averaged_down_to_the_level() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    small = at_level(rgb, 4)
    assert small.shape == (32, 64, 3)
    means = rgb.reshape(32, 2, 64, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - means).max() <= 0.5
    assert at_level(rgb, 5) is rgb
    assert at_level(rgb, 6) is rgb


def test_the_condition_does_not_change_what_is_visible() -> None:
    """The same keypoints, turned along, have the same partners and the same truth."""
    from tangent_train.results.keypoints.seen import Seen

    made = ball_pair(shape=(96, 192))
    comparer = Comparer(replace(WAYS, base_levels=(0,)), Matching(), turned=False)
    found = comparer.compare(made).found[AS_GIVEN]["L0"]
    turn = random_rotation(np.random.default_rng(5))
    geometry = replace(found.geometry, rotation=None, translation=None)
    turned = found._replace(right=found.right.turned(turn), geometry=geometry)
    seen = Seen(made, 1.0)
    one = seen.scored(found._replace(geometry=geometry), np.eye(3), AS_GIVEN, "L0")
    other = seen.scored(turned, turn, AS_GIVEN, "L0")
    assert one == other
