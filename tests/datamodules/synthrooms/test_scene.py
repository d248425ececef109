from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from datamodules.synthrooms.camera import PanoramaView, Pose
from datamodules.synthrooms.raycast import RayScene
from datamodules.synthrooms.render import MISSING, draw_camera, draw_holes, render
from datamodules.synthrooms.room import UNKNOWN, Room
from datamodules.synthrooms.scene import draw_room_type, furnish
from datamodules.synthrooms.writer import INSTANCES

SEEDS = range(60)


@pytest.fixture(scope="module")
def rooms() -> list[Room]:
    made = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        made.append(furnish(rng, draw_room_type(rng)))
    return made


def test_everything_stands_inside(rooms: list[Room]) -> None:
    for room in rooms:
        corners = np.concatenate([part.triangles.reshape(-1, 3) for part in room.parts])
        size = (room.plan.width, room.plan.depth, room.plan.height)
        # Walls are 10 cm thick; bases of columns at walls reach a little further into them.
        assert (corners > -0.13).all()
        assert (corners < np.add(size, 0.13)).all()


def test_every_class_covers_enough_pixels_in_enough_rooms(rooms: list[Room]) -> None:
    names = list(INSTANCES)
    pixels, present = np.zeros(len(names)), np.zeros(len(names))
    total, unknown, missing = 0, 0, 0
    for room in rooms:
        limits = Counter(room.items)
        assert all(limits[name] <= limit for name, limit in INSTANCES.items())
        scene = RayScene(room)
        holes = draw_holes(room.rng, scene)
        camera = draw_camera(room.rng, scene, room.plan, [])
        view = PanoramaView(Pose.looking(camera.location, camera.heading), 32)
        items = render(scene, view, camera, holes, 1, room.rng).items
        seen = Counter(room.items[k] for k in items[items != MISSING])
        counts = np.array([seen[name] for name in names])
        pixels, present = pixels + counts, present + (counts > 0)
        total += items.size
        unknown += seen[UNKNOWN]
        missing += int((items == MISSING).sum())
    shares = dict(zip(names, pixels / total, strict=True))
    assert min(shares.values()) > 0.01, shares
    assert (present / len(rooms)).min() > 0.45
    assert unknown > 0
    assert 0.02 < missing / total < 0.15
