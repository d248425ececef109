from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.core.depth import distance_from_z_depth
from datamodules.core.files import SPLITS
from datamodules.stanford2d3ds.files import AREAS, CLASSES, FOLDS
from datamodules.stanford2d3ds.panoramas import (
    Stanford2D3DS,
    Stanford2D3DSPerspective,
    read_label_table,
)
from tangent_train.errors import DataError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.rendering import (
    EquirectRepresentation,
    PerspectiveRepresentation,
    TangentRepresentation,
)
from tests.conftest import fabricate
from tests.datamodules.data_files import names_of, read_png, write_png


def test_pixels_of_instances_past_the_end_of_the_table_are_unknown(tmp_path: Path) -> None:
    # #0D0D0D without its red byte would be entry 3341 of the table.
    path = tmp_path / "semantic_labels.json"
    path.write_text(json.dumps(["<UNK>_0_<UNK>_0_0", *["clutter_1_office_1_1"] * 9815]))
    colors = [[i >> 16, i >> 8 & 255, i & 255] for i in (0x0D0D0D, 9815, 9816, 0xFFFFFF, 0)]
    labels = read_label_table(path).decode(np.array([colors], np.uint8))
    assert labels.tolist() == [[0, 6, 0, 0, 0]]


# --- splits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("fold", [1, 3])  # in fold 3, rooms of 5a and 5b are the same rooms
def test_folds_are_disjoint_and_rooms_stay_whole(stanford_root: Path, erp: Any, fold: Any) -> None:
    module = Stanford2D3DS(stanford_root, erp, fold=fold, seed=1, val_fraction=0.3)
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
    np.testing.assert_array_equal(panorama.depth, np.where(known, 512 + (classes - 1) * 128, 0))
    np.testing.assert_array_equal(panorama.rgb[..., 0], np.where(known, 5 + 15 * classes, 0))
    np.testing.assert_array_equal(panorama.rgb[..., 1], np.where(known, 245 - 15 * classes, 0))
    assert known.mean() == 7 / 8


# --- what cannot be used -----------------------------------------------------------------------


def test_missing_areas_and_other_files_are_refused(tmp_path: Path, erp: Any) -> None:
    root = fabricate(tmp_path / "data", dict.fromkeys(AREAS, ("office_1",)), height=16)
    (root / "area_5b").rename(root / "spare")
    with pytest.raises(DataError, match=r"area_5b/pano/rgb: found no images"):
        Stanford2D3DS(root, erp).setup()
    write_png(root / "area_1/pano/rgb/camera_0f_rgb.png", np.zeros((2, 4, 3), np.uint8))
    with pytest.raises(DataError, match="unknown file name"):
        Stanford2D3DS(root, erp, areas=["1", "5a"]).setup()


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
