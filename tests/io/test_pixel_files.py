"""Colors, depth and arrays of any pixel type, written and read as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms, TiffImagePlugin, features

from tangent_train.errors import DataError, SettingError
from tangent_train.io import pixel_files
from tangent_train.io.pixel_files import (
    check_writable,
    photo_fov_deg,
    read_depth_m,
    read_image_size,
    read_pixels,
    read_rgb,
    write_pixels,
)
from tests.datamodules.data_files import (
    as_displayed,
    exif_orientation,
    png_bytes,
    png_chunk,
    tiff_bytes,
)


def _noise(shape: tuple[int, ...], dtype: Any = np.uint8) -> NDArray[Any]:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape, dtype)


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        (".png", np.uint8),
        (".png", np.uint16),
        (".tif", np.uint8),
        (".TIFF", np.uint16),
        (".npy", np.float16),
        (".npy", np.bool_),
    ],
)
def test_written_pixels_are_read(
    suffix: str, dtype: Any, channels: tuple[int, ...], tmp_path: Path
) -> None:
    pixels = (_noise((7, 9, *channels)) / 255 * 250).astype(dtype)
    path = tmp_path / "new" / f"a (1){suffix}"
    write_pixels(path, pixels)
    again = read_pixels(path, indices=True)
    assert again.dtype == pixels.dtype
    np.testing.assert_array_equal(again, pixels)


@pytest.mark.parametrize(
    ("suffix", "dtype", "channels", "message"),
    [
        (".bmp", np.uint8, 3, r"\.bmp files: found"),
        (".png", np.float32, 1, r"float32 pixels of 1 channel; expected .*\.tif.*\.npy"),
        (".png", np.uint8, 2, r"expected .*\.npy"),
    ],
)
def test_files_that_cannot_hold_the_pixels(
    suffix: str, dtype: Any, channels: int, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        check_writable(suffix, dtype, channels)
    check_writable(".npy", dtype, channels)


# Colors


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits_become_8(tmp_path: Path, suffix: str, channels: int) -> None:
    values = _noise((5, 9, channels), np.uint16)
    values[0, :2] = [[0], [65535]]
    path = tmp_path / f"image{suffix}"
    assert cv2.imwrite(str(path), values)
    expected = np.broadcast_to(values[..., 2::-1] >> 8, (5, 9, 3))
    np.testing.assert_array_equal(read_rgb(path), expected)


def test_gray_palette_and_transparency_are_decoded(tmp_path: Path) -> None:
    rgb = _noise((6, 10, 3))
    alpha = _noise((6, 10))
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "rgba.png")
    Image.fromarray(rgb[..., 0]).save(tmp_path / "gray.png")
    Image.fromarray(np.dstack([rgb[..., 0], alpha]), "LA").save(tmp_path / "gray_alpha.png")
    Image.fromarray(rgb[..., 0] > 127).save(tmp_path / "bits.png")
    palette = Image.fromarray(alpha % 4, "P")
    colors = _noise((4, 3))
    palette.putpalette(colors.tobytes())
    palette.save(tmp_path / "palette.png")
    palette.save(tmp_path / "see_through.png", transparency=bytes([0, 100, 200, 255]))
    gray = np.repeat(rgb[..., :1], 3, axis=-1)
    expected = {
        "rgba": rgb,
        "gray": gray,
        "gray_alpha": gray,
        "bits": np.where(gray > 127, 255, 0),
        "palette": colors[alpha % 4],
        "see_through": colors[alpha % 4],
    }
    np.testing.assert_array_equal(read_pixels(tmp_path / "palette.png", indices=True), alpha % 4)
    for name, pixels in expected.items():
        np.testing.assert_array_equal(read_rgb(tmp_path / f"{name}.png"), pixels, err_msg=name)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (2,), (3,), (4,)])
def test_png_is_turned_by_its_exif_data(
    tmp_path: Path, dtype: Any, channels: tuple[int, ...]
) -> None:
    """Labels too."""
    stored = _noise((4, 6, *channels), dtype)
    path = tmp_path / "image.png"
    for orientation in range(1, 9):
        chunk = png_chunk(b"eXIf", exif_orientation(orientation))
        path.write_bytes(png_bytes(stored, before=chunk))
        shown = as_displayed(stored, orientation)
        expected = {2: shown[..., 0], 4: shown[..., :3]}.get(stored.size // 24, shown)
        np.testing.assert_array_equal(read_pixels(path, indices=True), expected)
        assert read_image_size(path) == expected.shape[:2]


_AVIF = pytest.mark.skipif(not features.check("avif"), reason="Pillow without AVIF")


@pytest.mark.parametrize("suffix", [".jpg", ".webp", pytest.param(".avif", marks=_AVIF)])
def test_other_formats_are_turned(tmp_path: Path, suffix: str) -> None:
    stored = np.kron(_noise((3, 5, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    best: dict[str, Any] = {"lossless": True} if suffix == ".webp" else {"quality": 100}
    for orientation in range(1, 9):
        path = tmp_path / f"{orientation}{suffix}"
        exif = b"Exif\0\0" + exif_orientation(orientation)
        Image.fromarray(stored).save(path, exif=exif, subsampling="4:4:4", **best)
        expected = as_displayed(stored, orientation)
        away = np.abs(read_rgb(path).astype(int) - expected)
        assert away.max() <= (0 if suffix == ".webp" else 8)
        assert read_image_size(path) == expected.shape[:2]


_FINE: dict[str, Any] = {"quality": 95, "subsampling": 0}
_SAVED: dict[str, tuple[str, dict[str, Any]]] = {
    "inks.jpg": ("CMYK", _FINE),
    "two pictures.jpg": ("RGB", {"format": "MPO", "quality": 95}),
    "two pictures.png": ("RGB", {}),
    "two pictures.tif": ("RGB", {}),
    "progressive.jpg": ("RGB", {"progressive": True, "quality": 95}),
    "a transparent color.png": ("RGB", {"transparency": (255, 0, 0)}),
    "transparent.png": ("RGBA", {}),
    "png.jpg": ("RGB", {"format": "PNG"}),
    "jpeg.png": ("RGB", {"format": "JPEG", **_FINE}),
    "jpeg.tif": ("RGB", {"compression": "jpeg"}),
    "lab.tif": ("LAB", {}),
}
"""Pixels and settings of Pillow by file."""


@pytest.mark.parametrize("name", _SAVED)
def test_colors_of_cameras_and_programs(tmp_path: Path, name: str) -> None:
    """Red and green over blue and white; the first picture of several."""
    corners = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    rgb = corners.repeat(32, axis=0).repeat(64, axis=1)
    mode, settings = _SAVED[name]
    image: Any = Image.fromarray(rgb)
    if mode == "LAB":
        srgb, lab = map(
            ImageCms.ImageCmsProfile,
            (ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB")),
        )
        image = ImageCms.profileToProfile(image, srgb, lab, outputMode="LAB")
    elif mode != "RGB":
        image = image.convert(mode)
    if mode == "RGBA":
        image.putalpha(0)
    if name.startswith("two"):
        settings = {**settings, "save_all": True, "append_images": [image.rotate(180)]}
    image.save(tmp_path / name, **settings)
    found = read_rgb(tmp_path / name)
    assert read_image_size(tmp_path / name) == found.shape[:2] == (64, 128)
    away = np.abs(found.astype(int) - rgb).max(axis=-1)
    assert (away < 60).mean() > 0.94, "some formats mix the pixels at edges"


# Layouts of TIFF files: of every one the pixels, or an error.


def _values(dtype: str, channels: int) -> NDArray[Any]:
    """Large and small, negative where the type allows it."""
    bits = 8 * np.dtype(dtype).itemsize
    values = np.arange(6 * 10 * channels).reshape(6, 10, channels) * 0.37 + 1
    if dtype[0] != "f":
        values = values / values.max() * 2.0 ** (bits - (dtype[0] == "i")) * 0.99
        values[::2] *= -1 if dtype[0] == "i" else 1
    return values.astype(dtype)[..., 0] if channels == 1 else values.astype(dtype)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i2", "f4"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("compression", [1, 8])
def test_tiff_gives_its_values_or_an_error(
    tmp_path: Path, dtype: str, order: str, channels: int, compression: int
) -> None:
    """Decoders return garbage for some of them: big-endian and compressed, of planes, above 2³¹."""
    values = _values(dtype, channels)
    kept = values[..., 0] if channels == 2 else values[..., :3] if channels > 3 else values
    kind = {"u": 1, "i": 2, "f": 3}[dtype[0]]
    extra = {338: [2] * (channels - 3)} if channels > 3 else {338: [2]} if channels == 2 else {}
    path = tmp_path / "image.tif"
    decoded = set()
    for planes in (1, 2):
        for fill in (1, 2):
            tags = {259: compression, 284: planes, 266: fill, 339: [kind] * channels, **extra}
            path.write_bytes(tiff_bytes(values, order, tags))
            try:
                found = read_pixels(path, indices=True)
            except DataError:
                continue
            np.testing.assert_array_equal(found, kept)
            assert found.dtype.isnative
            decoded.add((planes, fill))
    common = {("u1", 1), ("u1", 3), ("u1", 4), ("u2", 1), ("u2", 3), ("u2", 4), ("f4", 1)}
    if (dtype, channels) in common:
        assert (1, 1) in decoded


@pytest.mark.parametrize(
    ("dtype", "channels"), [("u1", 1), ("u1", 3), ("u2", 1), ("u2", 3), ("f4", 1)]
)
def test_tiff_is_turned(tmp_path: Path, dtype: str, channels: int) -> None:
    values, path = _values(dtype, channels), tmp_path / "image.tif"
    for orientation in range(1, 9):
        tags = {274: orientation, 339: [3 if dtype == "f4" else 1] * channels}
        path.write_bytes(tiff_bytes(values, tags=tags))
        expected = as_displayed(values, orientation)
        np.testing.assert_array_equal(read_pixels(path, indices=True), expected)
        assert read_image_size(path) == expected.shape[:2]


def test_other_tiff_files(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    values = _values("u2", 3)
    path.write_bytes(tiff_bytes(values, big=True))
    np.testing.assert_array_equal(read_pixels(path, indices=True), values)
    gray = _values("u1", 1)
    path.write_bytes(tiff_bytes(gray, tags={262: 0}))  # 0 is white
    np.testing.assert_array_equal(read_rgb(path)[..., 0], 255 - gray)
    inks = _values("u1", 4)
    path.write_bytes(tiff_bytes(inks, tags={262: 5}))
    expected = (255.0 - inks[..., :3]) * (255.0 - inks[..., 3:]) / 255
    assert np.abs(read_rgb(path) - expected).max() <= 1
    planes = {284: 2}
    path.write_bytes(tiff_bytes(values, tags=planes))
    np.testing.assert_array_equal(read_pixels(path, indices=False), values)


@pytest.mark.parametrize(
    ("pixels", "tags"),
    [
        (_values("u2", 1), {262: 0}),  # 0 is white
        (_values("u1", 3), {262: 6, 530: [2, 2]}),  # colors of fewer pixels
        (_values("u1", 3), {259: 34712}),  # JPEG 2000
        (_values("u2", 1), {262: 3}),  # a palette
    ],
)
def test_layouts_of_tiff_files_that_are_not_decoded_are_refused(
    tmp_path: Path, pixels: NDArray[Any], tags: dict[int, Any]
) -> None:
    path = tmp_path / "image.tif"
    path.write_bytes(tiff_bytes(pixels, tags=tags))
    with pytest.raises(DataError, match=r"image\.tif: found .*(layout|no image)"):
        read_pixels(path, indices=False)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("kinds", [[1, 0], [1, 1, 0], [0, 1], [1], [1, 1]])
def test_thumbnails_before_a_page_of_a_tiff_file_are_passed_over(
    tmp_path: Path, dtype: Any, kinds: list[int]
) -> None:
    """The first page is read where all are marked as thumbnails."""
    pages = [np.full((4 + n, 6), n + 1, dtype) for n in range(len(kinds))]
    path, chosen = tmp_path / "image.tif", pages[kinds.index(0) if 0 in kinds else 0]
    with path.open("w+b") as file, TiffImagePlugin.AppendingTiffWriter(file) as writer:
        for page, kind in zip(pages, kinds, strict=True):
            Image.fromarray(page).save(writer, "TIFF", tiffinfo={254: kind})
            writer.newFrame()
    np.testing.assert_array_equal(read_pixels(path, indices=True), chosen)
    assert read_image_size(path) == chosen.shape


@pytest.mark.parametrize(
    ("suffix", "modes"),
    [
        (".bmp", "RGB RGBA P L 1"),
        (".gif", "P L 1 animated"),
        pytest.param(".avif", "RGB RGBA L animated", marks=_AVIF),
    ],
)
def test_other_formats_are_decoded(tmp_path: Path, suffix: str, modes: str) -> None:
    """The first picture of an animation is read."""
    path, rgb = tmp_path / f"image{suffix}", np.kron(_noise((4, 8, 3)), np.ones((8, 8, 1)))
    for mode in modes.split():
        image = Image.fromarray(rgb.astype(np.uint8)).convert(mode.replace("animated", "P"))
        frames: dict[str, Any] = {"save_all": True, "append_images": [image.rotate(180)]}
        lossless: dict[str, Any] = (
            {"quality": 100, "subsampling": "4:4:4"} if suffix == ".avif" else {}
        )
        image.save(path, **lossless, **(frames if mode == "animated" else {}))
        read = read_rgb(path)
        assert read.shape == (32, 64, 3) == (*read_image_size(path), 3)
        difference = np.abs(read.astype(int) - np.array(image.convert("RGB")))
        assert difference.max() <= (4 if lossless else 0)
        path.write_bytes(path.read_bytes()[: 700 if mode == "animated" else -40])
        with pytest.raises(DataError, match=rf"image{suffix}: found no image that can be decoded"):
            read_rgb(path)


@pytest.mark.parametrize("read", [read_rgb, read_image_size, photo_fov_deg])
def test_files_that_are_not_images_are_refused(tmp_path: Path, read: Any) -> None:
    (tmp_path / "notes.jpg").write_text("no picture at all")
    (tmp_path / "folder.jpg").mkdir()
    Image.fromarray(np.ones((4, 8), np.float32)).save(tmp_path / "depth.tif")
    with pytest.raises(DataError, match=r"depth\.tif: found float32"):
        read_rgb(tmp_path / "depth.tif")
    for name in ("notes.jpg", "folder.jpg", "nowhere.jpg"):
        with pytest.raises(DataError, match=f"{name}: found"):
            read(tmp_path / name)


# Depth


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_depth_in_units(tmp_path: Path, suffix: str) -> None:
    units = np.array([[0, 1, 2500], [40000, 65534, 65535]], np.uint16)
    path = tmp_path / f"depth{suffix}"
    assert cv2.imwrite(str(path), units)
    depth = read_depth_m(path, 4000)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[0, 1 / 4000, 0.625], [10, 65534 / 4000, 0]], rtol=1e-7)
    np.save(tmp_path / "depth.npy", units.astype(np.int32))  # in which 65535 is depth
    assert read_depth_m(tmp_path / "depth.npy", 4000)[1, 2] == np.float32(65535 / 4000)
    assert read_image_size(path) == (2, 3)


_METERS = np.array([[0.5, np.nan, np.inf, -np.inf], [0, -1, 1e10, 9999]], np.float32)
_KNOWN = np.array([[0.5, 0, 0, 0], [0, 0, 0, 9999]], np.float32)


@pytest.mark.parametrize("dtype", [np.float16, ">f4"])
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
    assert read_image_size(path) == (2, 4)


def test_files_without_depth_are_refused(tmp_path: Path) -> None:
    Image.fromarray(_noise((4, 8))).save(tmp_path / "gray.png")
    Image.fromarray(_noise((4, 8, 3))).save(tmp_path / "color.png")
    np.save(tmp_path / "yes.npy", np.ones((4, 8), bool))
    for name in ("gray.png", "color.png", "yes.npy", "nowhere.npy"):
        with pytest.raises(DataError, match=f"{name}: found"):
            read_depth_m(tmp_path / name, 1000)


@pytest.mark.parametrize(
    ("bits", "suffix"), [(10, ".png"), (12, ".tif"), (14, ".png"), (16, ".png")]
)
def test_colors_of_few_bits_are_warned_of_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bits: int, suffix: str
) -> None:
    pixel_files._has_warned[0] = 0
    for name in "ab":
        path = tmp_path / f"{name}{suffix}"
        write_pixels(path, np.full((4, 8, 3), 2**bits - 1, np.uint16))
        read_rgb(path, as_stored=True)  # labels in colors
        assert not (name == "a" and pixel_files.has_warned_of_range())
        read_rgb(path)
    printed = capsys.readouterr().err
    assert printed.count("Warning: ") == (bits < 16)
    assert (f"a{suffix}: the largest value of 16-bit colors is {2**bits - 1}," in printed) == (
        bits < 16
    )
