"""Panoramas of SYNTHIA's views, against closed forms and against panoramas rendered directly."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.core.files import Problems
from datamodules.synthia.generate import make_panoramas
from datamodules.synthia.reader import VIEWS
from tangent_train.geometry import equirect_directions
from tests.datamodules import synthia_format as synthia
from tests.datamodules.data_files import contents, read_png
from tests.datamodules.synthia_format import HEIGHT, SIZE

DIRECTIONS = equirect_directions((HEIGHT, 2 * HEIGHT))
PARTS = {"rgb": "RGB", "labels": "GT/LABELS_Correct", "depth": "Depth"}


def make(root: Path, *sequences: str) -> None:
    problems = Problems()
    make_panoramas(root, sequences, problems, height=HEIGHT)
    problems.refuse(root)


def panorama(root: Path, part: str, sequence: str = "01", frame: int = 0) -> NDArray[Any]:
    folder = synthia.sequence(root, sequence) / "pano" / PARTS[part]
    return read_png(folder / f"{frame:06d}.png")


class Seen(NamedTuple):
    """The places of the panorama's pixels in the views, pixel by pixel in float64."""

    view: NDArray[np.int64]
    place: NDArray[np.float64]
    inside: NDArray[np.bool_]

    def nearest(self, views: NDArray[Any], elsewhere: int) -> NDArray[Any]:
        """The pixel of the views ``(4, h, w)`` nearest to each pixel of the panorama."""
        column, row = np.moveaxis(np.rint(self.place).astype(int), -1, 0)
        row, column = np.clip(row, 0, SIZE[0] - 1), np.clip(column, 0, SIZE[1] - 1)
        return np.where(self.inside, views[self.view, row, column], elsewhere)

    @property
    def certain(self) -> NDArray[np.bool_]:
        """Where no rounding decides which pixel is the nearest."""
        near: NDArray[np.bool_] = np.abs(self.place % 1 - 0.5).min(axis=-1) > 1e-3
        return near


@pytest.fixture(scope="module")
def seen() -> Seen:
    places = np.stack([synthia.project(DIRECTIONS, view) for view in VIEWS])
    view = places[..., 2].argmax(axis=0)
    place = np.take_along_axis(places, view[None, ..., None], axis=0)[0, ..., :2]
    edge = np.array([SIZE[1], SIZE[0]]) - 0.5
    inside = ((place >= -0.5) & (place <= edge)).all(axis=-1)
    seen = Seen(view, place, np.array(inside))
    assert 0.3 < seen.inside.mean() < 0.4
    assert seen.certain.mean() > 0.98
    return seen


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of two sequences and their panoramas; not to be changed."""
    root = synthia.write_views(tmp_path_factory.mktemp("synthia"), {"01": 3, "04": 1})
    make(root, "01", "04")
    return root


@pytest.fixture
def views(tmp_path: Path) -> Path:
    """Two frames without panoramas."""
    return synthia.write_views(tmp_path / "synthia", {"01": 2})


# --- geometry ------------------------------------------------------------------------------------


def test_labels_are_those_of_the_nearest_pixel_of_one_view(made: Path, seen: Seen) -> None:
    for frame in (0, 1):
        ids = np.stack([synthia.labels_of(synthia.view_rays(v), frame) for v in VIEWS])
        labels = panorama(made, "labels", frame=frame)
        assert labels.dtype == np.uint8
        expected = seen.nearest(ids, 255)
        np.testing.assert_array_equal(labels[seen.certain], expected[seen.certain])


def test_colors_are_those_of_the_world(made: Path, seen: Seen) -> None:
    rgb = panorama(made, "rgb")[..., ::-1]
    error = np.abs(rgb - synthia.rgb_of(DIRECTIONS))
    inner = (seen.place >= 0) & (seen.place <= np.array([SIZE[1] - 1, SIZE[0] - 1]))
    assert error[inner.all(axis=-1)].max() < 1.5
    assert error[seen.inside].max() < 4  # the outer half of the outermost pixels
    assert not rgb[~seen.inside].any()


def test_depth_is_the_distance_from_the_center(made: Path, seen: Seen) -> None:
    rays = np.stack([synthia.view_rays(view) for view in VIEWS])
    distance = np.rint(500 + 10 * rays[..., 2]) * np.linalg.norm(rays, axis=-1)
    distance[:, :2, :3] = 0  # as fabricated
    for frame in (0, 1):  # in one channel and in three
        depth = panorama(made, "depth", frame=frame)
        assert depth.dtype == np.uint16
        expected = seen.nearest(distance, 0)
        assert np.abs(depth - expected)[seen.certain].max() <= 0.5
        np.testing.assert_array_equal((depth == 0)[seen.certain], (expected == 0)[seen.certain])


# --- files ---------------------------------------------------------------------------------------


def test_missing_panoramas_are_made_and_others_kept(made: Path, views: Path) -> None:
    make(views, "01")
    pano = synthia.sequence(views, "01") / "pano"
    whole = contents(synthia.sequence(made, "01") / "pano")
    images = {name: content for name, content in contents(pano).items() if ".png" in name}
    assert images == {name: whole[name] for name in images}
    kept = pano / "RGB" / "000000.png"
    written = kept.stat().st_mtime_ns
    finished = (pano / "finished.jsonl").read_text().splitlines(keepends=True)
    (pano / "finished.jsonl").write_text(finished[0])
    (pano / "Depth" / "000001.png").unlink()
    make(views, "01")
    assert kept.stat().st_mtime_ns == written
    assert contents(pano)["Depth/000001.png"] == whole["Depth/000001.png"]
