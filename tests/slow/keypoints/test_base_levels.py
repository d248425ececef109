"""Keypoints on tangent images of more base levels, margins and rotations."""

from __future__ import annotations

import pytest

from tangent_train.geometry import TangentGrid
from tangent_train.keypoints import Detector, detect_on_tangent_images
from tests.keypoints import test_detect as checks
from tests.keypoints.test_detect import LEVEL, ROTATION, SHAPE, found_on_texture
from tests.keypoints.textures import Agreement, rotated, texture


@pytest.mark.parametrize("base_level", [1, 2])
def test_other_base_levels(base_level: int) -> None:
    checks.test_a_rotated_panorama_has_rotated_keypoints(base_level)
    checks.test_every_keypoint_is_owned_by_its_image_and_there_once(base_level)
    checks.test_a_blob_is_found_at_its_place_and_by_its_owner_alone(base_level)


def test_the_rotation_of_the_grid_counts() -> None:
    grid = TangentGrid(1, LEVEL, rotation=ROTATION)
    right = detect_on_tangent_images(texture(SHAPE, ROTATION), grid, Detector(), 16)
    agreement = Agreement(rotated(found_on_texture(1), ROTATION), right)
    assert agreement.share > 0.85
    assert agreement.error_deg < 0.05
