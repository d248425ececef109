from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tangent_train.errors import DataError
from tangent_train.geometry import equirect_to_lonlat
from tangent_train.inference.images import read_panorama
from tangent_train.io.gpano import (
    PART_TAGS,
    Eye,
    PanoramaArea,
    eye_part,
    read_area,
    read_tags,
    read_up,
    shape_of,
)
from tangent_train.orientation.gravity import up_from_pose
from tests.datamodules.data_files import (
    GPANO_TAGS,
    exif_orientation,
    gpano_xmp,
    png_bytes,
    png_chunk,
    save_tagged,
    xmp_packet,
)

_AREA = PanoramaArea((180, 360), (30, 70), (100, 160), (40, 60))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_tags_of_all_formats(tmp_path: Path, suffix: str) -> None:
    tags = GPANO_TAGS | {"ProjectionType": "Equirectangular"}
    path = save_tagged(tmp_path / f"image{suffix}", tags)
    assert read_area(path, (40, 60)) == _AREA


# XMP: ways to write the same, and places to write it to.

_PITCH, _ROLL = "-24.5", "8.96"
_UP = up_from_pose(-24.5, 8.96)
_RDF = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
_ATTRIBUTES = f'GPano:PosePitchDegrees="{_PITCH}" GPano:PoseRollDegrees="{_ROLL}"'
_ELEMENTS = (
    f"<GPano:PosePitchDegrees>{_PITCH}</GPano:PosePitchDegrees>"
    f"<GPano:PoseRollDegrees>{_ROLL}</GPano:PoseRollDegrees>"
)
_OTHERS = (  # of the image that this one was made from, and of another program
    '<m:Ingredients xmlns:m="of/another"><rdf:Bag><rdf:li rdf:parseType="Resource">'
    "<GPano:PosePitchDegrees>1</GPano:PosePitchDegrees></rdf:li>"
    '<rdf:li><rdf:Description GPano:PosePitchDegrees="2"/></rdf:li></rdf:Bag></m:Ingredients>'
    '<m:PosePitchDegrees xmlns:m="of/another">3</m:PosePitchDegrees>'
)


def _described(old: str = "", new: str = "") -> str:
    elements = _ELEMENTS.replace(old, new) if old else _ELEMENTS
    return f"<rdf:Description>{elements}</rdf:Description>"


_FORMS = {
    "attributes": f'<rdf:Description rdf:about="" {_ATTRIBUTES}/>',
    "references": f"<rdf:Description {_ATTRIBUTES}/>".replace("-24", "&#x2d;&#50;4"),
    "elements": _described(),
    "white space": _described(f">{_PITCH}<", f">\n\t{_PITCH}<"),
    "two descriptions": f"<rdf:Description/><rdf:Description {_ATTRIBUTES}/>",
    "beside others": f"<rdf:Description>{_OTHERS}{_ELEMENTS}{_OTHERS}</rdf:Description>",
    "after others": f"<rdf:Description {_ATTRIBUTES}>{_OTHERS}</rdf:Description>",
    "comments": _described(f">{_PITCH}<", f"><!-- ° -->-<![CDATA[{_PITCH[1:]}]]><"),
    "language": _described("PitchDegrees>-", 'PitchDegrees xml:lang="x-default">-'),
}


def _jpeg(*segments: bytes) -> bytes:
    """A JPEG file with APP1 segments."""
    file = io.BytesIO()
    Image.new("RGB", (60, 40)).save(file, "JPEG")
    parts = [b"\xff\xe1" + (len(s) + 2).to_bytes(2, "big") + s for s in segments]
    return b"".join([file.getvalue()[:2], *parts, file.getvalue()[2:]])


def _adobe(packet: bytes) -> bytes:
    return b"http://ns.adobe.com/xap/1.0/\0" + packet


@pytest.mark.parametrize("form", _FORMS)
def test_forms_of_xmp(tmp_path: Path, form: str) -> None:
    packet = xmp_packet(_FORMS[form].replace("GPano", "photo-sphere"), "photo-sphere")
    (tmp_path / "image.jpg").write_bytes(_jpeg(_adobe(packet)))
    np.testing.assert_array_equal(read_up(tmp_path / "image.jpg"), _UP)


def test_places_of_xmp(tmp_path: Path) -> None:
    packet = xmp_packet(_FORMS["attributes"])
    title = b"XML:com.adobe.xmp\0"
    chunks = {
        "plain": png_chunk(b"iTXt", title + b"\0\0\0\0" + packet),
        "compressed": png_chunk(b"iTXt", title + b"\1\0en\0\0" + zlib.compress(packet)),
    }
    pixels = np.zeros((40, 60, 3), np.uint8)
    files = {f"{name}, before.png": png_bytes(pixels, before=c) for name, c in chunks.items()}
    files |= {f"{name}, behind.png": png_bytes(pixels, behind=c) for name, c in chunks.items()}
    files["main.jpg"] = _jpeg(b"Exif\0\0" + exif_orientation(1), _adobe(packet))
    files["padded.jpg"] = _jpeg(_adobe(packet + b" \n" * 2000 + b"\0"))
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    Image.fromarray(pixels).save(tmp_path / "xmp.tif", tiffinfo={700: packet})
    Image.fromarray(pixels).save(tmp_path / "xmp.webp", xmp=packet, lossless=True)
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_array_equal(read_up(path), _UP, err_msg=path.name)


@pytest.mark.parametrize(
    "packet",
    [
        xmp_packet(_FORMS["attributes"])[:-60],
        xmp_packet(_FORMS["attributes"]).replace(b"rdf:about", b"other:about"),
    ],
    ids=["truncated", "unknown prefix"],
)
def test_xmp_that_cannot_be_read(tmp_path: Path, packet: bytes) -> None:
    """Refused with these tags, ignored without them."""
    path = tmp_path / "image.jpg"
    path.write_bytes(_jpeg(_adobe(packet)))
    with pytest.raises(DataError, match=r"image\.jpg: found XMP data that .*exiftool"):
        read_up(path)
    with pytest.raises(DataError, match="XMP data"):  # it may say that the picture is stereo
        read_panorama(path, (-30, 30, -20, 20))
    old, new = (name.encode("utf-16-le") for name in ("photos", "videos"))
    other = packet.replace(b"photos", b"videos").replace(old, new)
    path.write_bytes(_jpeg(_adobe(other)))
    assert read_up(path) is None


def test_images_that_say_nothing(tmp_path: Path) -> None:
    Image.new("RGB", (60, 40)).save(tmp_path / "none.jpg")
    incomplete = {k: v for k, v in GPANO_TAGS.items() if k != "CroppedAreaTopPixels"}
    other = save_tagged(tmp_path / "other.jpg", GPANO_TAGS)
    other.write_bytes(other.read_bytes().replace(b"photos/1.0/panorama", b"photos/1.0/image"))
    for path in (
        tmp_path / "none.jpg",
        save_tagged(tmp_path / "incomplete.jpg", incomplete),
        other,
    ):
        assert read_area(path, (30, 60)) == read_area(Path("image"), (30, 60)), path.name
        with pytest.raises(DataError, match="a whole panorama"):
            read_area(path, (40, 60))
        assert read_up(path) is None


@pytest.mark.parametrize("size", [(20, 30), (80, 120), (33, 50)])
def test_resized_images_show_the_same(tmp_path: Path, size: tuple[int, int]) -> None:
    path = save_tagged(tmp_path / "image.jpg", GPANO_TAGS, size)
    area = read_area(path, size)
    assert area is not None
    assert area.image_shape == size
    west, north = _angles_deg(area, (area.columns[0], area.rows[0]))
    east, south = _angles_deg(area, (area.columns[1], area.rows[1]))
    pixel_deg = 180 / area.full_shape[0]
    assert np.allclose([west, east, south, north], [-80, -20, 20, 60], atol=1.01 * pixel_deg)
    known = area.place(np.ones(size, bool))
    assert known.shape == area.full_shape
    assert abs(known.sum() - size[0] * size[1]) <= max(size)


def test_a_left_edge_before_the_panorama_is_near_its_right_edge(tmp_path: Path) -> None:
    """Stitchers write negative left edges of panoramas across ±180°."""
    left = int(GPANO_TAGS["CroppedAreaLeftPixels"])
    turn = int(GPANO_TAGS["FullPanoWidthPixels"])
    tags = GPANO_TAGS | {"CroppedAreaLeftPixels": str(left - turn)}
    area = read_area(save_tagged(tmp_path / "before.jpg", tags), (40, 60))
    assert area == read_area(save_tagged(tmp_path / "image.jpg", GPANO_TAGS), (40, 60))


def _angles_deg(area: PanoramaArea, corner_xy: tuple[int, int]) -> NDArray[np.float64]:
    """Longitude and latitude of the upper left corner of a pixel."""
    return np.degrees(equirect_to_lonlat(np.subtract(corner_xy, 0.5), area.full_shape))


@pytest.mark.parametrize(
    ("changes", "size", "found"),
    [
        ({"ProjectionType": "cylindrical"}, (40, 60), "cylindrical"),
        ({"FullPanoHeightPixels": "100"}, (40, 60), "tags"),
        ({"CroppedAreaLeftPixels": "nan"}, (40, 60), "nan"),
        ({}, (40, 50), r"33\.3 .*tags"),
        ({"FullPanoWidthPixels": "9e7", "FullPanoHeightPixels": "4.5e7"}, (40, 60), "columns"),
    ],
)
def test_tags_that_cannot_be_are_refused(
    tmp_path: Path, changes: dict[str, str], size: tuple[int, int], found: str
) -> None:
    path = save_tagged(tmp_path / "image.jpg", GPANO_TAGS | changes)
    with pytest.raises(DataError, match=rf"image\.jpg: found .*{found}"):
        read_area(path, size)


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
    area = read_area(Path("image"), (10, width))
    assert area.full_shape == (10, 20)
    assert area.is_whole
    image = np.arange(10 * width).reshape(10, width)
    placed = area.place(image)
    assert placed.shape == (10, 20)
    assert set(np.diff(placed[0])) <= {0, 1, 2}
    cut = area.cut(placed)
    assert cut.shape == image.shape
    assert np.abs(cut - image).max() <= (width != 20)


@pytest.mark.parametrize("size", [(10, 18), (10, 22)])
def test_other_shapes_are_refused(size: tuple[int, int]) -> None:
    message = rf"a: found {size[1]} × {size[0]} .*area=.*GPano.*photo, give fov=.*projection="
    with pytest.raises(DataError, match=message):
        read_area(Path("a"), size)


# The setting


@pytest.mark.parametrize("seed", range(4))
def test_edges_are_at_the_angles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    across, down = rng.uniform(20, 350), rng.uniform(10, 170)
    west = rng.uniform(-180, 180)
    east = (west + across + 180) % 360 - 180
    south = rng.uniform(-90, 90 - down)
    width = int(rng.integers(300, 900))
    size = (round(width * down / across), width)
    area = read_area(Path("image"), size, (west, east, south, south + down))
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


def test_pixels_that_are_not_square_are_refused() -> None:
    with pytest.raises(DataError, match=r"found 100 × 100 .*expected 100 × 25 .*area=\[0, 40"):
        read_area(Path("image"), (100, 100), (0, 40, 0, 10))


# Pose


@pytest.mark.parametrize(
    ("pitch", "roll"),
    [("-24.49", "-121"), ("5.0", "0"), ("0.0", "-0")],
)
def test_zero_pitch_and_roll_are_unknown(tmp_path: Path, pitch: str, roll: str) -> None:
    """Programs write zero pitch and roll by default."""
    tags = {"PosePitchDegrees": pitch, "PoseRollDegrees": roll}
    up = read_up(save_tagged(tmp_path / "image.jpg", tags))
    expected = None if float(pitch) == 0 else up_from_pose(float(pitch), float(roll))
    np.testing.assert_array_equal(up, expected)


@pytest.mark.parametrize("value", ["181", "nan", "steep"])
def test_impossible_poses_are_refused(tmp_path: Path, value: str) -> None:
    path = save_tagged(tmp_path / "image.jpg", {"PosePitchDegrees": value})
    with pytest.raises(DataError, match=r"image\.jpg: found GPano:Pose.*expected numbers from"):
        read_up(path)


_TOP, _BOTTOM = np.s_[0:64, 0:128], np.s_[64:128, 0:128]
_LEFT, _RIGHT = np.s_[0:64, 0:128], np.s_[0:64, 128:256]
_FULL = dict(zip(PART_TAGS, map(str, (800, 800, 800, 800, 0, 0)), strict=True))
_HALF_SPHERE = dict(zip(PART_TAGS, map(str, (800, 400, 400, 400, 200, 0)), strict=True))


@pytest.mark.parametrize(
    ("size", "tags", "area", "left", "right"),
    [
        ((128, 128), {}, None, _TOP, _BOTTOM),
        ((64, 256), {}, None, _LEFT, _RIGHT),
        ((128, 128), {"StereoMode": "Bottom-Top"}, None, _BOTTOM, _TOP),
        ((128, 128), {"StereoMode": "mono"}, None, _TOP, _BOTTOM),
        ((128, 128), _FULL, None, _TOP, _BOTTOM),
        ((64, 128), _HALF_SPHERE, None, np.s_[0:64, 0:64], np.s_[0:64, 64:128]),
        ((128, 64), {}, [-90, 90, -90, 90], np.s_[0:64, 0:64], np.s_[64:128, 0:64]),
    ],
)
def test_the_picture_of_an_eye(
    size: tuple[int, int], tags: dict[str, str], area: Any, left: Any, right: Any
) -> None:
    """By metadata, or the layout in which both are whole or of the area."""
    eyes: dict[Eye, Any] = {"left": left, "right": right}
    for eye, part in eyes.items():
        assert eye_part(Path("a"), size, eye, area, tags) == part
        shape = shape_of(size, part)
        assert read_area(Path("a"), shape, area, tags=tags).image_shape == shape
    if "top" in tags.get("StereoMode", "").lower():
        with pytest.raises(DataError, match=r"a: found a stereo panorama .*eye=left or eye=right"):
            eye_part(Path("a"), size, None, area, tags)
    else:
        assert shape_of(size, eye_part(Path("a"), size, None, area, tags)) == size
        with pytest.raises(DataError, match=r"stereo panorama.*eye=left or eye=right"):
            read_area(Path("a"), size, area, tags=tags)


def test_unknown_kinds_of_stereo_are_refused() -> None:
    with pytest.raises(DataError, match=r"a: found a stereo panorama \(custom\)"):
        eye_part(Path("a"), (64, 128), None, None, {"StereoMode": "custom"})


@pytest.mark.parametrize(
    ("size", "tags", "area"),
    [
        ((64, 128), {}, None),
        ((40, 60), GPANO_TAGS, None),
        ((64, 256), {}, [-180, 180, -45, 45]),
        ((64, 128), {"StereoMode": "top-bottom"}, None),
    ],
)
def test_an_eye_of_what_is_not_stereo_is_refused(
    size: tuple[int, int], tags: dict[str, str], area: Any
) -> None:
    with pytest.raises(DataError, match=r"a: found .*two pictures.*Leave eye= out"):
        eye_part(Path("a"), size, "right", area, tags)


def test_spherical_tags_of_exiftool_are_read(tmp_path: Path) -> None:
    space = "http://ns.google.com/videos/1.0/spherical/"
    xmp = gpano_xmp({"StereoMode": "top-bottom"}).decode()
    packet = xmp.replace("http://ns.google.com/photos/1.0/panorama/", space)
    Image.new("RGB", (64, 64)).save(tmp_path / "a.jpg", xmp=packet.encode())
    assert read_tags(tmp_path / "a.jpg") == {"StereoMode": "top-bottom"}
