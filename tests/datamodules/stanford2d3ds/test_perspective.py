from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from datamodules import Stanford2D3DS, Stanford2D3DSPerspective
from datamodules.core.found import SPLITS
from datamodules.core.panoramas import distance_from_z_depth
from tangent_train.errors import DataError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.rendering import PerspectiveRepresentation, TangentRepresentation
from tests.conftest import FabricateStanford
from tests.datamodules.data_files import names_of, read_png

CROPS = PerspectiveRepresentation(level=5, evaluation="grid", crops_per_photo=2)


@pytest.fixture(scope="module")
def photo_root(
    tmp_path_factory: pytest.TempPathFactory, fabricate_stanford: FabricateStanford
) -> Path:
    return fabricate_stanford(tmp_path_factory.mktemp("photos"), photos=2)


@pytest.fixture
def broken_root(tmp_path: Path, fabricate_stanford: FabricateStanford) -> Path:
    return fabricate_stanford(tmp_path / "data", photos=1)


# --- reading -----------------------------------------------------------------------------------


def test_a_photo_is_what_the_files_hold(photo_root: Path) -> None:
    source = Stanford2D3DSPerspective(photo_root, CROPS).source("test")
    photo, name = source.read(1), source.name(1)
    area, room, camera, frame = name.split("/")
    stem = f"camera_{camera}_{room}_frame_{frame}_domain"
    data = photo_root / area / "data"
    np.testing.assert_array_equal(photo.rgb, read_png(data / "rgb" / f"{stem}_rgb.png")[..., ::-1])
    z = read_png(data / "depth" / f"{stem}_depth.png")
    assert photo.depth is not None
    assert (photo.depth[z == 65535] == 0).all(), "missing"
    assert (photo.labels[z == 65535] == 0).all(), "#0D0D0D is unknown, not clutter"
    # Distance of a pixel at (x, y) from the middle of a picture of 32 pixels that sees 62°.
    focal = 16 / math.tan(math.radians(31))
    for row, column in ((10, 3), (20, 30), (31, 0)):
        x, y = column + 0.5 - 16, row + 0.5 - 16
        expected = z[row, column] * math.sqrt(1 + (x * x + y * y) / focal**2)
        assert photo.depth[row, column] == pytest.approx(expected, abs=0.51)
    np.testing.assert_allclose(
        photo.camera_matrix, camera_matrix_from_fov(62, (32, 32)), err_msg="counted from centres"
    )


def test_distances_saturate_and_holes_stay_holes() -> None:
    z = np.array([[0, 65535], [60000, 512]], np.uint16)
    camera = camera_matrix_from_fov(90, (2, 2))
    # Pixels at (±½, ±½) with f = 1: √1.5 times the z-depth.
    np.testing.assert_array_equal(distance_from_z_depth(z, camera), [[0, 65535], [65535, 627]])


# --- splits ------------------------------------------------------------------------------------


def test_photos_are_split_as_the_panoramas(photo_root: Path) -> None:
    photos = Stanford2D3DSPerspective(photo_root, CROPS, fold=2, seed=3, validation_fraction=0.3)
    panoramas = Stanford2D3DS(
        photo_root, TangentRepresentation(0, 4), fold=2, seed=3, validation_fraction=0.3
    )
    for split in SPLITS:
        shown, whole = names_of(photos, split), names_of(panoramas, split)
        assert len(shown) == 2 * len(whole) > 0
        assert {name.rpartition("/")[0] for name in shown} == set(whole)


# --- samples -----------------------------------------------------------------------------------


def test_samples(photo_root: Path) -> None:
    module = Stanford2D3DSPerspective(
        photo_root, CROPS, photos_per_step=3, validation_fraction=0, in_memory=True
    )
    batch = next(iter(module.train_dataloader()))
    assert [part.shape for part in batch.images] == [(3, 2, 16, 16, 3), (3, 2, 16, 16)]
    assert batch.labels.shape == (3, 2, 16, 16)
    first, *_ = module.test_dataloader()
    # 60° in crops of 45°: two across, two down.
    assert first.target.shape == (1, 4, 16, 16)
    quarter = (first.target[0] > 0).float().mean(dim=(1, 2))
    assert (quarter < 0.75).all(), "what another crop owns does not count"


# --- what cannot work --------------------------------------------------------------------------


def test_a_photo_that_sees_less_than_a_crop_is_named(broken_root: Path) -> None:
    module = Stanford2D3DSPerspective(broken_root, PerspectiveRepresentation(5, fov_deg=70))
    next(broken_root.glob("area_5a/data/pose/*.json")).unlink()
    with pytest.raises(DataError, match=r"pose\.json: found .*No such file"):
        module.setup()
    message = r"rgb\.png: found 70° × 70° for an image that spans 60° × 60°; expected all of a crop"
    with pytest.raises(DataError, match=message):
        module.setup()
