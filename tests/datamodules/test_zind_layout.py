"""Labels and distances of layouts, against brute force and closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from datamodules.zind.layout import CLASSES, DOOR, OPENING, WINDOW, Fixture, Layout
from tests.datamodules.zind_format import (
    CORNERED,
    KINDS,
    SQUARE,
    Camera,
    Room,
    brute_force_labels,
)

LABELS = {"doors": DOOR, "windows": WINDOW, "openings": OPENING}
SPLIT_WALL = Room(
    # The upper wall in three pieces, with a window across all of them.
    [(-2, -1), (2, -1), (2, 1), (1, 1), (-0.5, 1), (-2, 1)],
    {"windows": [((-1.5, 1), (1.5, 1), (-0.5, 0.5))], "doors": [((2, -1), (2, 1), (-1, 3))]},
)
# Fixtures that go on behind the corner of two walls: the other wall has no part of them.
BEHIND = Room(
    [(0, 0), (3, 0), (3, 2), (0, 2)],
    {"doors": [((-0.02, 0), (0.9, 0), (-1, 0.5))], "windows": [((3, 1), (3, 2.03), (-0.5, 0.5))]},
)
COMB = Room([(-3, -1), (3, -1), (3, 3), (2, 3), (2, 0.5), (0.5, 0.5), (0.5, 3), (-0.5, 3),
             (-0.5, 1), (-3, 1)])  # fmt: skip
VIEWS = {
    "square": (SQUARE, Camera("")),
    "turned": (SQUARE, Camera("", (0.3, -0.2), 33)),
    "close to a wall": (SQUARE, Camera("", (1.9999, 0.4), 200)),
    "in a corner": (SQUARE, Camera("", (-1.999, -1.499), -80)),
    "concave": (CORNERED, Camera("", (1.1, 0.9), 14)),
    "concave, doors hidden": (CORNERED, Camera("", (4.5, 1.2), 3)),
    "fixtures across corners": (SPLIT_WALL, Camera("", (0.1, 0.2), -50)),
    "fixtures behind a corner": (BEHIND, Camera("", (0.2, 0.3), 21)),
    "another": (BEHIND, Camera("", (2.9, 1.9), 111)),
    "comb": (COMB, Camera("", (-1.3, -0.3), 81)),
}


def _layout(given: dict[str, Any], ceiling_z: float) -> Layout:
    fixtures = [
        Fixture(np.array([start, end]), low, high, LABELS[kind])
        for kind in KINDS
        for start, end, (low, high) in np.array(given[kind]).reshape(-1, 3, 2)
    ]
    return Layout(np.array(given["vertices"]), -1.0, ceiling_z, fixtures)


@pytest.mark.parametrize("view", VIEWS)
def test_labels_are_those_of_brute_force(view: str) -> None:
    (room, camera), shape = VIEWS[view], (33, 66)
    given = camera.layout(room)
    expected = brute_force_labels(given, room.ceiling_z, shape)
    found = _layout(given, room.ceiling_z).labels(shape)
    np.testing.assert_array_equal(found, expected)
    seen = {3, *(KINDS[kind] for kind in room.fixtures)} - ({0, 4} if "hidden" in view else set())
    assert seen <= set(np.unique(found))


def test_the_frame_is_x_left_y_to_the_middle() -> None:
    door = Fixture(np.array([[0.2, 1.0], [0.8, 1.0]]), -1.0, 0.5, DOOR)
    labels = Layout(np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]), -1, 1, [door]).labels(
        (90, 180)
    )
    rows, columns = np.nonzero(labels == DOOR)
    # From 0.2 to 0.8 left of the middle at distance 1; its sill meets the floor at 45° or less.
    lowest, highest = (-math.degrees(math.atan(x)) / 2 + 89.5 for x in (0.8, 0.2))
    assert columns.min() == math.ceil(lowest)
    assert columns.max() == math.floor(highest)
    assert rows.max() < 90 * (90 + 45) / 180
    assert (labels[0] == 1 + CLASSES.index("ceiling")).all()
    assert (labels[-1] == 1 + CLASSES.index("floor")).all()


def test_fixtures_a_little_off_their_wall_are_on_it() -> None:
    shifted = Room(SQUARE.vertices, {"windows": [((-1, 1.52), (0.5, 1.49), (-0.4, 0.4))]})
    near, exact = (_layout(Camera("").layout(r), 0.6).labels((64, 128)) for r in (shifted, SQUARE))
    assert (near == 5).sum() == pytest.approx((exact == 5).sum(), rel=0.05)
