"""Synthetic data sets are the same for any number of processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from datamodules.synthrooms.generate import RoomSettings, generate_rooms
from datamodules.synthshapes import generate as shapes
from datamodules.synthshapes.generate import ShapeSettings, generate_shapes
from tests.datamodules.data_files import contents

ROOMS = RoomSettings(
    rooms={"1": 2, "5b": 1}, height=16, views_per_camera=1, view_size=8, supersample=1
)


@pytest.mark.parametrize(
    ("generate", "settings"),
    [(generate_rooms, ROOMS), (generate_shapes, ShapeSettings(train=1, test=1))],
)
def test_the_same_bytes_for_any_number_of_processes(
    generate: Any, settings: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shapes, "_PER_PROCESS", 1)
    for workers in (0, 2):
        generate(tmp_path / f"{workers}", settings, workers=workers)
    assert contents(tmp_path / "2") == contents(tmp_path / "0")
