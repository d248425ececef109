from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import Stanford2D3DS, Stanford2D3DSPerspective
from datamodules.core.images import distance_from_z_depth, steps_to_meters
from datamodules.core.splits import SPLITS
from datamodules.stanford2d3ds.files import AREAS, CLASSES, FOLDS, FileName
from datamodules.stanford2d3ds.reader import read_label_table
from tangent_train.errors import DataError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.rendering import (
    EquirectRepresentation,
    PerspectiveRepresentation,
    TangentRepresentation,
)
from tests.conftest import fabricate
from tests.datamodules.data_files import names_of, read_png


def _colors(indices: list[int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.array([[[i >> 16, i >> 8 & 255, i & 255] for i in indices]], np.uint8)


def test_pixels_of_instances_past_the_end_of_the_table_are_unknown(tmp_path: Path) -> None:
    # #0D0D0D without its red byte would be entry 3341 of the table.
    (tmp_path / "table.json").write_text(json.dumps(["clutter_1_office_1_1"] * 9816))
    table = read_label_table(tmp_path / "table.json")
    colors = _colors([0x0D0D0D, 9815, 9816, 0xFFFFFF])
    assert table.decode(colors).tolist() == [[0, 6, 0, 0]]


# --- names -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "camera_0f_office_1_frame_equirectangular_domain_rgb.png",
        f"camera_{'0f' * 16}_office_1_frame_left_domain_rgb.png",
    ],
)
def test_other_file_names_are_refused(name: str) -> None:
    with pytest.raises(DataError, match="unknown file name"):
        FileName.parse(name)


# --- splits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("fold", [1, 3])  # in fold 3, rooms of 5a and 5b are the same rooms
def test_folds_are_disjoint_and_rooms_stay_whole(
    stanford_root: Path, erp: Any, fold: int, seed: int
) -> None:
    module = Stanford2D3DS(stanford_root, erp, fold=fold, seed=seed, val_fraction=0.3)
    module.setup("fit")
    splits = {split: names_of(module, split) for split in ("train", "val", "test")}
    names = [name for split in splits.values() for name in split]
    assert len(names) == len(set(names)) == len(list(stanford_root.glob("area_*/pano/rgb/*.png")))
    assert {n.split("/")[0] for n in splits["test"]} == {f"area_{area}" for area in FOLDS[fold]}
    rooms = {
        split: {n.rpartition("/")[0].replace("5b", "5a") for n in split_names}
        for split, split_names in splits.items()
    }
    assert rooms["val"]
    assert not rooms["train"] & rooms["val"]


# --- reading -----------------------------------------------------------------------------------


@pytest.mark.parametrize("erp_height", [32, 8])
def test_reads_what_was_written(stanford_root: Path, erp_height: int) -> None:
    module = Stanford2D3DS(stanford_root, EquirectRepresentation(3, erp_height=erp_height))
    source = module.dataset("test")
    area, room, camera = source.name(1).split("/")
    folder = stanford_root / area / "pano"
    panorama = source.read(1)
    assert panorama.rgb.shape == (erp_height, 2 * erp_height, 3)
    assert panorama.depth is not None
    dtypes = [a.dtype.name for a in (panorama.rgb, panorama.depth, panorama.labels)]
    assert dtypes == ["uint8", "uint16", "uint8"]
    # Blocks of 4×4 pixels: at these sizes every pixel is one block's.
    step = 32 // erp_height
    stem = f"camera_{camera}_{room}_frame_equirectangular_domain"
    semantic = read_png(folder / "semantic" / f"{stem}_semantic.png")
    blue, green, red = np.moveaxis(semantic[::step, ::step].astype(int), -1, 0)
    table = json.loads((stanford_root / "semantic_labels.json").read_text())
    ids = {i: CLASSES.index(name.split("_")[0]) + 1 for i, name in enumerate(table) if i}
    classes = np.vectorize(lambda i: ids.get(i, 0))(red * 65536 + green * 256 + blue)
    assert classes.max() > 1
    np.testing.assert_array_equal(panorama.labels, classes)
    known = classes > 0
    np.testing.assert_array_equal(
        steps_to_meters(panorama.depth), np.where(known, 1 + (classes - 1) / 4, np.nan)
    )
    np.testing.assert_array_equal(panorama.rgb[..., 0], np.where(known, 5 + 15 * classes, 0))
    np.testing.assert_array_equal(panorama.rgb[..., 1], np.where(known, 245 - 15 * classes, 0))
    assert known.mean() == 7 / 8


def test_masks_are_applied_on_reading(stanford_root: Path, erp: Any) -> None:
    labeled, masked = (
        Stanford2D3DS(stanford_root, erp, unknown=unknown).dataset("train").read(0).labels
        for unknown in ("labels", "any_black")
    )
    assert not masked[-2:, :4].any(), "a patch without blue"
    assert labeled[-2:, :4].all()


# --- what cannot be used -----------------------------------------------------------------------


def test_wrong_layouts_are_refused(tmp_path: Path, erp: Any) -> None:
    broken_root = fabricate(tmp_path / "data", dict.fromkeys(AREAS, ("office_1",)), height=16)
    with pytest.raises(DataError, match="no area_1, area_2"):
        Stanford2D3DS(broken_root / "area_1", erp).setup()
    (broken_root / "area_5b").rename(broken_root / "spare")
    with pytest.raises(DataError, match=r"found no area_5b; expected all of area_1"):
        Stanford2D3DS(broken_root, erp).setup()
    (broken_root / "area_5b" / "data").mkdir(parents=True)
    with pytest.raises(DataError, match=r"area_5b/pano/rgb: found no panoramas"):
        Stanford2D3DS(broken_root, erp).setup()


# --- photos ---------------------------------------------------------------------------------------


CROPS = PerspectiveRepresentation(level=5, crops_per_photo=2)


@pytest.fixture(scope="module")
def photo_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fabricate(tmp_path_factory.mktemp("photos"), photos=2)


# --- reading -----------------------------------------------------------------------------------


def test_a_photo_is_what_the_files_hold(photo_root: Path) -> None:
    source = Stanford2D3DSPerspective(photo_root, CROPS).dataset("test")
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
        photo.camera_matrix, camera_matrix_from_fov(62, (32, 32)), err_msg="counted from centers"
    )


def test_distances_saturate_and_holes_stay_holes() -> None:
    z = np.array([[0, 65535], [60000, 512]], np.uint16)
    camera = camera_matrix_from_fov(90, (2, 2))
    # Pixels at (±½, ±½) with f = 1: √1.5 times the z-depth.
    np.testing.assert_array_equal(distance_from_z_depth(z, camera), [[0, 65535], [65535, 627]])


# --- splits ------------------------------------------------------------------------------------


def test_photos_are_split_as_the_panoramas(photo_root: Path) -> None:
    photos = Stanford2D3DSPerspective(photo_root, CROPS, fold=2, seed=3, val_fraction=0.3)
    panoramas = Stanford2D3DS(
        photo_root, TangentRepresentation(0, 4), fold=2, seed=3, val_fraction=0.3
    )
    for split in SPLITS:
        shown, whole = names_of(photos, split), names_of(panoramas, split)
        assert len(shown) == 2 * len(whole) > 0
        assert {name.rpartition("/")[0] for name in shown} == set(whole)


# --- samples -----------------------------------------------------------------------------------


def test_samples_of_photos(photo_root: Path) -> None:
    module = Stanford2D3DSPerspective(
        photo_root, CROPS, batch_size=3, val_fraction=0, in_memory=True
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


def test_a_photo_that_sees_less_than_a_crop_or_has_no_pose_is_named(tmp_path: Path) -> None:
    broken_root = fabricate(tmp_path, photos=1)
    module = Stanford2D3DSPerspective(broken_root, PerspectiveRepresentation(5, fov_deg=70))
    next(broken_root.glob("area_5a/data/pose/*.json")).unlink()
    with pytest.raises(DataError, match=r"pose\.json: found .*No such file"):
        module.setup()
    message = (
        r"found 70° × 70° for an image that spans 60° × 60°, .*rgb\.png; expected all of a crop"
    )
    with pytest.raises(DataError, match=message):
        module.setup()
