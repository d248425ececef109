"""Cameras, labels and frames of SYNTHIA."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datamodules.synthia.reader import read_view_camera


def _write_camera(folder: Path, text: str) -> Path:
    path = folder / "CameraParams" / "intrinsics.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    ["532.740352\n640\n380\n0.8\n", "532.740352, 640, 380", None],
)
def test_cameras_are_read(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        _write_camera(tmp_path, text)
    camera = read_view_camera(tmp_path, (760, 1280))
    # Counted from pixel corners the center is the middle of the image; so it is here.
    expected = [[532.740352, 0, 639.5], [0, 532.740352, 379.5], [0, 0, 1]]
    np.testing.assert_array_equal(camera, expected)
