from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from datamodules.images.gpano import PanoramaArea, area_of, area_of_crop, up_of, whole_area
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import equirect_to_lonlat
from tangent_train.rendering.upright.gravity import up_from_pose
from tests.datamodules.data_files import GPANO_TAGS, gpano_xmp


def _save(
    path: Path,
    tags: Mapping[str, str],
    shape: tuple[int, int] = (40, 60),
    *,
    elements: bool = False,
) -> Path:
    xmp = gpano_xmp(tags, elements=elements)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    formats: dict[str, Any] = {".png": {"pnginfo": text}, ".tif": {"tiffinfo": {700: xmp}}}
    settings = formats.get(path.suffix, {"xmp": xmp})
    Image.new("RGB", (shape[1], shape[0])).save(path, **settings)
    return path


_AREA = PanoramaArea((180, 360), (30, 70), (100, 160), (40, 60))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("elements", [False, True])
def test_tags_of_all_formats(tmp_path: Path, suffix: str, elements: bool) -> None:
    path = _save(tmp_path / f"image{suffix}", GPANO_TAGS, elements=elements)
    assert area_of(path, (40, 60)) == _AREA


def test_images_that_say_nothing(tmp_path: Path) -> None:
    Image.new("RGB", (60, 40)).save(tmp_path / "none.jpg")
    incomplete = {k: v for k, v in GPANO_TAGS.items() if k != "CroppedAreaTopPixels"}
    other = _save(tmp_path / "other.jpg", GPANO_TAGS)
    other.write_bytes(other.read_bytes().replace(b"photos/1.0/panorama", b"photos/1.0/image"))
    for path in (tmp_path / "none.jpg", _save(tmp_path / "incomplete.jpg", incomplete), other):
        assert area_of(path, (30, 60)) == whole_area(path, (30, 60)), path.name
        with pytest.raises(DataError, match="a whole panorama"):
            area_of(path, (40, 60))
        assert up_of(path) is None


@pytest.mark.parametrize("size", [(20, 30), (80, 120), (27, 40), (33, 50)])
def test_resized_images_show_the_same(tmp_path: Path, size: tuple[int, int]) -> None:
    path = _save(tmp_path / "image.jpg", GPANO_TAGS, size)
    area = area_of(path, size)
    assert area is not None
    assert area.image_shape == size
    west, north = _angles_deg(area, (area.columns[0], area.rows[0]))
    east, south = _angles_deg(area, (area.columns[1], area.rows[1]))
    pixel_deg = 180 / area.full_shape[0]
    assert np.allclose([west, east, south, north], [-80, -20, 20, 60], atol=1.01 * pixel_deg)
    known = area.place(np.ones(size, bool))
    assert known.shape == area.full_shape
    assert abs(known.sum() - size[0] * size[1]) <= max(size)


def _angles_deg(area: PanoramaArea, corner_xy: tuple[int, int]) -> NDArray[np.float64]:
    """Longitude and latitude of the upper left corner of a pixel."""
    return np.degrees(equirect_to_lonlat(np.subtract(corner_xy, 0.5), area.full_shape))


@pytest.mark.parametrize(
    ("changes", "size", "found"),
    [
        ({"ProjectionType": "cylindrical"}, (40, 60), "GPano:ProjectionType cylindrical"),
        ({"FullPanoWidthPixels": "many"}, (40, 60), "GPano:FullPanoWidthPixels 'many'"),
        ({"FullPanoHeightPixels": "100"}, (40, 60), r"of 100×360 .*expected a part"),
        ({"CroppedAreaTopPixels": "150"}, (40, 60), r"at \(150, 100\) of 180×360"),
        ({"CroppedAreaImageWidthPixels": "0"}, (40, 60), "40×0 pixels"),
        ({}, (40, 50), r"in an image of 40×50; .*may have been cut after"),
        ({"FullPanoWidthPixels": "9e7", "FullPanoHeightPixels": "4.5e7"}, (40, 60), "columns"),
    ],
)
def test_tags_that_cannot_be_are_refused(
    tmp_path: Path, changes: dict[str, str], size: tuple[int, int], found: str
) -> None:
    path = _save(tmp_path / "image.jpg", GPANO_TAGS | changes)
    with pytest.raises(DataError, match=rf"image\.jpg: found .*{found}"):
        area_of(path, size)


# Placing and cutting


@pytest.mark.parametrize(
    "area",
    [
        PanoramaArea((8, 16), (2, 5), (3, 8), (3, 5)),
        PanoramaArea((8, 16), (0, 8), (12, 20), (8, 8)),
        PanoramaArea((8, 16), (5, 8), (15, 31), (3, 16)),
        PanoramaArea((8, 16), (0, 8), (5, 21), (8, 16)),
    ],
)
@pytest.mark.parametrize(("channels", "dtype"), [((3,), np.uint8), ((), np.float32)])
def test_place_and_cut(area: PanoramaArea, channels: tuple[int, ...], dtype: Any) -> None:
    shape = (*area.image_shape, *channels)
    image = np.random.default_rng(0).integers(1, 250, shape).astype(dtype)
    placed = area.place(image)
    assert placed.dtype == image.dtype
    whole = np.zeros((8, 16, *channels))
    for column in range(image.shape[1]):
        whole[slice(*area.rows), (area.columns[0] + column) % 16] = image[:, column]
    np.testing.assert_array_equal(placed, whole)
    np.testing.assert_array_equal(area.cut(placed), image)


@pytest.mark.parametrize("width", [19, 20, 21])
def test_whole_panoramas_may_lack_a_column_or_have_one_more(tmp_path: Path, width: int) -> None:
    area = whole_area(tmp_path / "image.jpg", (10, width))
    assert area.full_shape == (10, 20)
    assert area.is_whole
    image = np.arange(10 * width).reshape(10, width)
    placed = area.place(image)
    assert placed.shape == (10, 20)
    assert set(np.diff(placed[0])) <= {0, 1, 2}
    cut = area.cut(placed)
    assert cut.shape == image.shape
    assert np.abs(cut - image).max() <= (width != 20)


@pytest.mark.parametrize("size", [(10, 18), (10, 22), (1, 1)])
def test_other_shapes_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    message = rf"a\.jpg: found {size[0]}×{size[1]} pixels.*crop=.*GPano.*projection=perspective"
    with pytest.raises(DataError, match=message):
        whole_area(tmp_path / "a.jpg", size)


# The setting


@pytest.mark.parametrize("seed", range(12))
def test_edges_are_where_the_crop_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    across, down = rng.uniform(20, 350), rng.uniform(10, 170)
    west = rng.uniform(-180, 180)
    east = (west + across + 180) % 360 - 180
    south = rng.uniform(-90, 90 - down)
    width = int(rng.integers(300, 900))
    size = (round(width * down / across), width)
    area = area_of_crop(size, (west, east, south, south + down))
    pixel_deg = 180 / area.full_shape[0]
    left, top = _angles_deg(area, (area.columns[0], area.rows[0]))
    assert abs((left - west + 180) % 360 - 180) <= pixel_deg
    assert abs(top - (south + down)) <= pixel_deg
    assert abs((area.columns[1] - area.columns[0]) * pixel_deg - across) <= 2 * pixel_deg
    assert abs((area.rows[1] - area.rows[0]) * pixel_deg - down) <= 2 * pixel_deg
    assert 0 <= area.columns[0] < area.full_shape[1]
    assert 0 <= area.rows[0] < area.rows[1] <= area.full_shape[0]
    image = rng.integers(0, 255, size, np.uint8)
    cut = area.cut(area.place(image))
    assert (cut == image).mean() > 0.98


@pytest.mark.parametrize(
    ("crop", "message"),
    [
        ((-180, 180, -90), r"found \[-180, 180, -90\]; expected \[west,east,south,north\]"),
        ((0, 181, -90, 90), "expected .*−180 to 180"),
        ((0, 90, 20, 20), "south below north"),
        ((180, -180, 0, 10), "east other than west"),
        ((0, 40, 0, 10), r"pixels of 0\.4°×0\.1° in an image of 100×100; .* square"),
    ],
)
def test_impossible_crops(crop: tuple[float, ...], message: str) -> None:
    with pytest.raises(SettingError, match=f"crop: found .*{message}|{message}"):
        area_of_crop((100, 100), crop)


# Pose


@pytest.mark.parametrize("elements", [False, True])
@pytest.mark.parametrize(("pitch", "roll"), [("-24.49", "-121"), ("5.0", "0"), ("0.0", "-0")])
def test_pose(tmp_path: Path, elements: bool, pitch: str, roll: str) -> None:
    """Zero pitch and roll is what programs write that do not know."""
    tags = {"PosePitchDegrees": pitch, "PoseRollDegrees": roll}
    up = up_of(_save(tmp_path / "image.jpg", tags, elements=elements))
    expected = None if float(pitch) == 0 else up_from_pose(float(pitch), float(roll))
    np.testing.assert_array_equal(up, expected)


def test_impossible_poses(tmp_path: Path) -> None:
    for axis, value in (("Pitch", "91"), ("Roll", "nan"), ("Roll", "180.5"), ("Roll", "steep")):
        path = _save(tmp_path / "image.jpg", {f"Pose{axis}Degrees": value})
        message = rf"image\.jpg: found GPano:Pose{axis}Degrees .*expected a number from"
        with pytest.raises(DataError, match=message):
            up_of(path)
