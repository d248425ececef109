from __future__ import annotations

import io
import math
import re
import struct
import zlib
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from datamodules.images.image_files import (
    find_images,
    photo_fov_deg,
    read_depth_m,
    read_depth_size,
    read_image_size,
    read_rgb,
)
from tangent_train.errors import DataError, SettingError


def _noise(shape: tuple[int, ...], dtype: Any = np.uint8) -> NDArray[Any]:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape, dtype)


def _smooth(height: int, width: int) -> NDArray[np.uint8]:
    """What JPEG keeps within a few steps: slopes that differ by direction and channel."""
    v, u = np.mgrid[:height, :width]
    slopes = [255 * u / width, 255 * v / height, 255 - 120 * (u / width + v / height)]
    return np.stack(slopes, axis=-1).astype(np.uint8)


# Finding files


def _touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_a_folder_is_searched_for_images_only(tmp_path: Path) -> None:
    names = ["b.JPG", "a.png", "deep/er/c.TIFF", "deep/d.webp", "e.jpeg", "f.tif"]
    others = ["notes.txt", ".hidden.jpg", ".thumbnails/a.jpg", "jpg", "deep/x.jpg.part"]
    _touch(*(tmp_path / name for name in names + others))
    (tmp_path / "folder.png").mkdir()
    found = find_images(tmp_path)
    assert found == sorted(tmp_path / name for name in names)
    assert find_images(str(tmp_path)) == found


def test_a_hidden_folder_that_is_asked_for_is_searched(tmp_path: Path) -> None:
    _touch(tmp_path / ".secret" / "a.png")
    assert find_images(tmp_path / ".secret") == [tmp_path / ".secret" / "a.png"]


def test_linked_folders_are_searched_once(tmp_path: Path) -> None:
    _touch(tmp_path / "here" / "a.png", tmp_path / "there" / "deep" / "b.png")
    (tmp_path / "here" / "link").symlink_to(tmp_path / "there")
    (tmp_path / "there" / "deep" / "back").symlink_to(tmp_path / "here")
    found = [str(path.relative_to(tmp_path)) for path in find_images(tmp_path / "here")]
    assert found == ["here/a.png", "here/link/deep/b.png"]


def test_a_file_is_found_whatever_it_is_called(tmp_path: Path) -> None:
    odd = tmp_path / "room [1] *.panorama"
    _touch(odd, tmp_path / "room 1 x.jpg")
    assert find_images(odd) == [odd]


def test_a_folder_with_the_characters_of_a_pattern_is_that_folder(tmp_path: Path) -> None:
    _touch(tmp_path / "[ab]" / "x.png", tmp_path / "a" / "y.png")
    assert find_images(tmp_path / "[ab]") == [tmp_path / "[ab]" / "x.png"]


def test_patterns(tmp_path: Path) -> None:
    _touch(*(tmp_path / name for name in ("a1.jpg", "a2.png", "b1.jpg", "s/a3.JPG", "s/t/a4.jpg")))
    _touch(tmp_path / "a5.txt", tmp_path / ".a6.jpg")

    def names(pattern: str) -> list[str]:
        return [str(path.relative_to(tmp_path)) for path in find_images(tmp_path / pattern)]

    assert names("a*") == ["a1.jpg", "a2.png"]
    assert names("[ab]1.jpg") == ["a1.jpg", "b1.jpg"]
    assert names("**/a?.*") == ["a1.jpg", "a2.png", "s/a3.JPG", "s/t/a4.jpg"]


def test_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    _touch(tmp_path / "pictures" / "a.jpg", tmp_path / "~b.jpg")
    assert find_images("~/pictures/*.jpg") == [tmp_path / "pictures" / "a.jpg"]
    assert find_images("~b.jpg") == [Path("~b.jpg")]


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("nowhere.jpg", "found nothing"),
        ("*.txt", "found 1 files, none of them"),
        ("empty", "found nothing"),
    ],
)
def test_no_images(tmp_path: Path, pattern: str, found: str) -> None:
    _touch(tmp_path / "notes.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=rf"{re.escape(pattern)}: {found}.*\.webp"):
        find_images(tmp_path / pattern)


# Colours


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_lossless_formats_give_the_pixels_written(tmp_path: Path, suffix: str) -> None:
    rgb = _noise((301, 7, 3))  # more rows than are converted at once, odd sizes
    path = tmp_path / f"image{suffix}"
    Image.fromarray(rgb).save(path, lossless=True)
    read = read_rgb(path)
    np.testing.assert_array_equal(read, rgb)
    assert read.flags.c_contiguous
    assert read.flags.writeable
    assert read_image_size(path) == (301, 7)


def test_jpeg_gives_the_pixels_of_another_decoder(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    Image.fromarray(_smooth(40, 81)).save(path, quality=90)
    other = cv2.imread(str(path))
    assert other is not None
    np.testing.assert_array_equal(read_rgb(path), other[..., ::-1])


def test_the_content_counts_not_the_name(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    Image.fromarray(_noise((4, 8, 3))).save(path, "PNG")
    np.testing.assert_array_equal(read_rgb(path), _noise((4, 8, 3)))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_16_bits_become_8(tmp_path: Path, suffix: str, channels: int) -> None:
    values = _noise((5, 9, channels), np.uint16)
    values[0, :2] = [[0], [65535]]
    path = tmp_path / f"image{suffix}"
    assert cv2.imwrite(str(path), values[..., ::-1])
    expected = np.broadcast_to(values >> 8, (5, 9, 3))
    np.testing.assert_array_equal(read_rgb(path), expected)


def test_big_endian_16_bit_tiff(tmp_path: Path) -> None:
    values = _noise((4, 6), np.uint16)
    tags = [(256, 4, 6), (257, 4, 4), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 8)]
    tags += [(277, 3, 1), (278, 4, 4), (279, 4, values.nbytes)]
    entries = b"".join(
        struct.pack(">HHI", tag, kind, 1)
        + struct.pack(">HH" if kind == 3 else ">I", *((value, 0) if kind == 3 else (value,)))
        for tag, kind, value in tags
    )
    path = tmp_path / "image.tif"
    pixels = values.astype(">u2").tobytes()
    path.write_bytes(
        struct.pack(">2sHI", b"MM", 42, 8 + len(pixels))
        + pixels
        + struct.pack(">H", len(tags))
        + entries
        + bytes(4)
    )
    np.testing.assert_array_equal(read_rgb(path)[..., 1], values >> 8)
    np.testing.assert_array_equal(
        read_depth_m(path, 1000), np.where(values == 65535, 0, values / np.float32(1000))
    )


def test_grey_palette_and_transparency(tmp_path: Path) -> None:
    rgb = _noise((6, 10, 3))
    alpha = _noise((6, 10))
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "rgba.png")
    Image.fromarray(rgb[..., 0]).save(tmp_path / "grey.png")
    Image.fromarray(np.dstack([rgb[..., 0], alpha]), "LA").save(tmp_path / "grey_alpha.png")
    Image.fromarray(rgb[..., 0] > 127).save(tmp_path / "bits.png")
    palette = Image.fromarray(alpha % 4, "P")
    colors = _noise((4, 3))
    palette.putpalette(colors.tobytes())
    palette.save(tmp_path / "palette.png")
    palette.save(tmp_path / "see_through.png", transparency=bytes([0, 100, 200, 255]))
    grey = np.repeat(rgb[..., :1], 3, axis=-1)
    expected = {
        "rgba": rgb,
        "grey": grey,
        "grey_alpha": grey,
        "bits": np.where(grey > 127, 255, 0),
        "palette": colors[alpha % 4],
        "see_through": colors[alpha % 4],
    }
    for name, pixels in expected.items():
        np.testing.assert_array_equal(read_rgb(tmp_path / f"{name}.png"), pixels, err_msg=name)


def test_cmyk_jpeg_has_its_colors(tmp_path: Path) -> None:
    rgb = _smooth(32, 64)
    path = tmp_path / "print.jpg"
    Image.fromarray(rgb).convert("CMYK").save(path, quality=95)
    assert np.abs(read_rgb(path).astype(int) - rgb).max() < 12


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_exif_orientation(tmp_path: Path, suffix: str, orientation: int) -> None:
    stored = Image.fromarray(_smooth(24, 40))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path = tmp_path / f"image{suffix}"
    stored.save(path, exif=exif, lossless=True)
    plain = tmp_path / f"plain{suffix}"
    stored.save(plain, lossless=True)
    with Image.open(plain) as image:
        upright = image.convert("RGB")
    upright.getexif()[ExifTags.Base.Orientation] = orientation
    expected = np.asarray(ImageOps.exif_transpose(upright))
    np.testing.assert_array_equal(read_rgb(path), expected)
    assert read_image_size(path) == expected.shape[:2]


def test_broken_exif_data_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    Image.fromarray(_noise((4, 8, 3))).save(path, exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    np.testing.assert_array_equal(read_rgb(path), _noise((4, 8, 3)))
    assert photo_fov_deg(path) is None


def _encoded(image_format: str) -> bytes:
    buffer = io.BytesIO()
    compression = {"compression": "tiff_lzw"} if image_format == "TIFF" else {}
    Image.fromarray(_noise((64, 128, 3))).save(buffer, image_format, **compression)
    return buffer.getvalue()


@pytest.mark.parametrize("image_format", ["JPEG", "PNG", "TIFF", "WEBP"])
@pytest.mark.parametrize("kept", [0, 3, 20, 0.5, 0.97])
# What is said about the file is an error here; a decoder may have warned before.
@pytest.mark.filterwarnings("ignore:Truncated File Read:UserWarning")
@pytest.mark.filterwarnings("ignore:Corrupt EXIF data:UserWarning")
def test_cut_files_are_explained(tmp_path: Path, image_format: str, kept: float) -> None:
    content = _encoded(image_format)
    path = tmp_path / "image.jpg"
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(DataError, match=r"image\.jpg: found .*; expected a whole JPEG, .*again\."):
        read_rgb(path)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damage_gives_pixels_or_an_explanation_and_nothing_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "image"
    explained = 0
    for image_format in ("JPEG", "PNG", "TIFF", "WEBP"):
        whole = np.frombuffer(_encoded(image_format), np.uint8)
        for _ in range(60):
            damaged = whole.copy()
            # Headers are where decoders trip.
            damaged[rng.integers(0, min(300, whole.size), 3)] = rng.integers(0, 256, 3)
            path.write_bytes(damaged.tobytes())
            for read in (read_image_size, read_rgb, photo_fov_deg):
                try:
                    read(path)
                except DataError:
                    explained += 1
    assert explained > 100


@pytest.mark.parametrize("read", [read_rgb, read_image_size, photo_fov_deg])
def test_not_images(tmp_path: Path, read: Any) -> None:
    (tmp_path / "notes.jpg").write_text("no picture at all")
    for name, found in [
        ("nowhere.jpg", "No such file"),
        ("", "Is a directory"),
        ("notes.jpg", "no image that can be decoded;"),
    ]:
        with pytest.raises(DataError, match=found):
            read(tmp_path / name)


def _png_header(width: int, height: int, compressed: bytes = zlib.compress(bytes(1000))) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        end = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + end

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", compressed)
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(32770, 16384), (60000, 60000)])
def test_files_that_would_fill_the_memory_are_refused(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(_png_header(*size))
    with pytest.raises(DataError, match=r"expected at most 536870912 pixels\. Shrink"):
        read_image_size(path)


def test_the_largest_panoramas_are_allowed(tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(_png_header(32768, 16384, bytes(1_600_000)))
    assert read_image_size(path) == (16384, 32768)
    path.write_bytes(_png_header(32768, 16384, bytes(1_500_000)))
    with pytest.raises(DataError, match=r"16384×32768 pixels, and 15\d{5} bytes; expected 156"):
        read_image_size(path)


def test_floats_are_no_colors(tmp_path: Path) -> None:
    path = tmp_path / "depth.tif"
    Image.fromarray(np.ones((4, 8), np.float32)).save(path)
    with pytest.raises(DataError, match=r"depth\.tif: found 32-bit floats"):
        read_rgb(path)


# Field of view


def _photo(path: Path, size: tuple[int, int], film_mm: Any, orientation: int = 1) -> Path:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: film_mm}
    Image.new("RGB", size).save(path, exif=exif)
    return path


def test_field_of_view_of_film_shaped_photos(tmp_path: Path) -> None:
    across = photo_fov_deg(_photo(tmp_path / "a.jpg", (360, 240), 50))
    assert across == pytest.approx(math.degrees(2 * math.atan(18 / 50)))
    upright = photo_fov_deg(_photo(tmp_path / "b.jpg", (240, 360), 50))
    assert upright == pytest.approx(math.degrees(2 * math.atan(12 / 50)))


def test_field_of_view_of_other_shapes_has_the_diagonal_of_film(tmp_path: Path) -> None:
    fov_deg = photo_fov_deg(_photo(tmp_path / "a.jpg", (400, 300), 26))
    assert fov_deg is not None
    across = 2 * math.tan(math.radians(fov_deg) / 2)
    assert across * 5 / 4 == pytest.approx(math.hypot(36, 24) / 26)


def test_field_of_view_is_that_of_the_photo_as_it_is_looked_at(tmp_path: Path) -> None:
    turned = photo_fov_deg(_photo(tmp_path / "a.jpg", (360, 240), 50, orientation=6))
    assert turned == pytest.approx(math.degrees(2 * math.atan(12 / 50)))


def test_no_field_of_view(tmp_path: Path) -> None:
    assert photo_fov_deg(_photo(tmp_path / "a.jpg", (360, 240), 0)) is None, "unknown"
    Image.new("RGB", (4, 8)).save(tmp_path / "b.png")
    assert photo_fov_deg(tmp_path / "b.png") is None


# Depth


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_depth_in_units(tmp_path: Path, suffix: str) -> None:
    units = np.array([[0, 1, 2500], [40000, 65534, 65535]], np.uint16)
    path = tmp_path / f"depth{suffix}"
    assert cv2.imwrite(str(path), units)
    depth = read_depth_m(path, 4000)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[0, 1 / 4000, 0.625], [10, 65534 / 4000, 0]], rtol=1e-7)
    assert read_depth_size(path) == (2, 3)


_METERS = np.array([[0.5, np.nan, np.inf, -np.inf], [0, -1, 1e10, 9999]], np.float32)
_KNOWN = np.array([[0.5, 0, 0, 0], [0, 0, 0, 9999]], np.float32)


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
def test_depth_in_meters_tiff(tmp_path: Path, compression: Literal["tiff_lzw"] | None) -> None:
    path = tmp_path / "depth.TIFF"
    Image.fromarray(_METERS).save(path, compression=compression)
    np.testing.assert_array_equal(read_depth_m(path, 1000), _KNOWN)
    assert read_depth_size(path) == (2, 4)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize("axes", [2, 3])
# 1e10 is infinite in 16 bits.
@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")
def test_depth_in_meters_array(tmp_path: Path, dtype: Any, axes: int) -> None:
    path = tmp_path / "depth.npy"
    np.save(path, _METERS.astype(dtype).reshape(_METERS.shape + (1,) * (axes - 2)))
    depth = read_depth_m(path, 1000)
    np.testing.assert_array_equal(depth, _KNOWN.astype(dtype).astype(np.float32))
    assert depth.dtype == np.dtype(np.float32)
    assert depth.dtype.isnative
    assert read_depth_size(path) == (2, 4)


def test_depth_in_units_array(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    np.save(path, np.array([[0, 65535, 70000]], np.int32))
    np.testing.assert_array_equal(read_depth_m(path, 1000), np.array([[0, 65.535, 70]], np.float32))


def test_depth_is_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    np.save(path, np.array([{}], object), allow_pickle=True)
    for read in (lambda: read_depth_m(path, 1000), lambda: read_depth_size(path)):
        with pytest.raises(DataError, match=r"depth\.npy: found .*expected a NumPy array"):
            read()


def test_what_is_no_depth(tmp_path: Path) -> None:
    Image.fromarray(_noise((4, 8))).save(tmp_path / "grey.png")
    Image.fromarray(_noise((4, 8, 3))).save(tmp_path / "color.png")
    np.save(tmp_path / "line.npy", np.ones(4))
    np.save(tmp_path / "yes.npy", np.ones((4, 8), bool))
    np.savez(tmp_path / "pack.npz", np.ones((4, 8)))
    (tmp_path / "pack.npz").rename(tmp_path / "pack.npy")
    (tmp_path / "empty.npy").touch()
    for name, found in [
        ("grey.png", "an image of 8 bits"),
        ("color.png", "an image of RGB"),
        ("line.npy", r"float64 of shape \(4,\)"),
        ("yes.npy", r"bool of shape \(4, 8\)"),
        ("pack.npy", r"a \.npz archive"),
        ("empty.npy", "No data left|EOF"),
        ("nowhere.npy", "No such file"),
        ("nowhere.exr", "No such file"),
    ]:
        with pytest.raises(DataError, match=rf"{name}: found .*{found}"):
            read_depth_m(tmp_path / name, 1000)


@pytest.mark.parametrize("units", [0, -1, math.nan, math.inf])
def test_impossible_units(tmp_path: Path, units: float) -> None:
    with pytest.raises(SettingError, match="more than 0"):
        read_depth_m(tmp_path / "depth.png", units)
