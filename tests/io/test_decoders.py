"""Colors of embedded profiles against LittleCMS and formulas, and damage that Pillow ignores."""

from __future__ import annotations

import zlib
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageCms

from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_pixels, read_rgb
from tests.datamodules.data_files import png_bytes, png_chunk

_D50 = (0.9642, 1, 0.8249)
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
_D65_XY = (0.3127, 0.3290)
_SRGB_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
_SRGB = ImageCms.createProfile("sRGB")


def _xyz(values: Any) -> bytes:
    return b"XYZ \0\0\0\0" + b"".join(
        round(v * 65536).to_bytes(4, "big", signed=True) for v in values
    )


def _curve(gamma: float) -> bytes:
    return (
        b"curv"
        + bytes(4)
        + (1).to_bytes(4, "big")
        + round(gamma * 256).to_bytes(2, "big")
        + bytes(2)
    )


def _profile(space: bytes, pcs: bytes, tags: dict[bytes, bytes]) -> bytes:
    """Write an ICC profile of version 2 (ICC.1:2001-04)."""
    text = b"desc" + bytes(4) + (5).to_bytes(4, "big") + b"test\0" + bytes(79)
    tags = {b"desc": text, b"wtpt": _xyz(_D50), b"cprt": b"text\0\0\0\0none\0\0\0\0", **tags}
    body, table = b"", b""
    for key, value in tags.items():
        at = 132 + 12 * len(tags) + len(body)
        table += key + at.to_bytes(4, "big") + len(value).to_bytes(4, "big")
        body += value + bytes(-len(value) % 4)
    head = b"\2\x10\0\0" + (b"prtr" if space == b"CMYK" else b"mntr") + space + pcs
    head = bytes(8) + head + bytes(12) + b"acsp" + bytes(28) + _xyz(_D50)[8:] + bytes(48)
    rest = head[4:] + len(tags).to_bytes(4, "big") + table + body
    return (len(rest) + 4).to_bytes(4, "big") + rest


def _rgb_profile(primaries: Any = _SRGB_XY, white: Any = _D65_XY, gamma: float = 2.2) -> bytes:
    """Return a profile of primaries (xy), the white point adapted to D50, and a gamma."""
    to_xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (*primaries, white)]).T
    matrix = to_xyz[:, :3] * np.linalg.solve(to_xyz[:, :3], to_xyz[:, 3])
    scale = (_BRADFORD @ _D50) / (_BRADFORD @ to_xyz[:, 3])
    matrix = np.linalg.inv(_BRADFORD) @ np.diag(scale) @ _BRADFORD @ matrix
    tags = {b"%cXYZ" % c: _xyz(column) for c, column in zip(b"rgb", matrix.T, strict=True)}
    return _profile(b"RGB ", b"XYZ ", tags | {b"%cTRC" % c: _curve(gamma) for c in b"rgb"})


def _ink_profile() -> bytes:
    """Return a CMYK profile whose table of 2⁴ colors differs from Pillow's own conversion."""
    inks = np.stack(np.meshgrid(*4 * [[0, 1]], indexing="ij"), -1).reshape(-1, 4)
    c, m, y, k = inks.T
    lab = np.stack([230 - 40 * (c + m + y) - 90 * k, 128 + 60 * (m - c), 128 + 50 * (y - c)], -1)
    ramp = bytes(range(256))
    table = b"mft1\0\0\0\0\4\3\2\0" + b"".join(
        int(v).to_bytes(4, "big") for v in np.eye(3).ravel() * 65536
    )
    table += ramp * 4 + lab.clip(0, 255).astype(np.uint8).tobytes() + ramp * 3
    return _profile(b"CMYK", b"Lab ", {b"A2B0": table})


_PROFILES = {
    "Display P3": _rgb_profile(((0.68, 0.32), (0.265, 0.69), (0.15, 0.06))),
    "ProPhoto": _rgb_profile(
        ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), (0.3457, 0.3585), 1.8
    ),
    "linear": _rgb_profile(gamma=1),
    "swapped": _rgb_profile(_SRGB_XY[::-1]),
    "gray": _profile(b"GRAY", b"XYZ ", {b"kTRC": _curve(1.4)}),
    "inks": _ink_profile(),
}
_COLORS = np.kron(np.random.default_rng(0).integers(20, 236, (4, 8, 3)), np.ones((8, 8, 1))).astype(
    np.uint8
)
_SAVED: dict[str, tuple[str, dict[str, Any]]] = {
    "a.png": ("RGB", {}),
    "alpha.png": ("RGBA", {}),
    "a.jpg": ("RGB", {"quality": 90}),
    "a.tif": ("RGB", {"compression": "tiff_lzw"}),
    "a.webp": ("RGB", {"lossless": True}),
    "a.avif": ("RGB", {}),
    "a.heic": ("RGB", {}),
    "gray of colors.jpg": ("L", {}),
    "gray alpha.png": ("LA", {}),
    "inks.jpg": ("CMYK", {"quality": 95}),
}


def _of_lcms(image: Image.Image, profile: bytes) -> NDArray[np.int16]:
    source: Any = ImageCms.ImageCmsProfile(BytesIO(profile))
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    converted: Any = ImageCms.profileToProfile(image, source, _SRGB, intent, "RGB")
    return np.asarray(converted, np.int16)


@pytest.mark.parametrize("name", _SAVED)
def test_embedded_profiles_are_converted_to_srgb(tmp_path: Path, name: str) -> None:
    mode, settings = _SAVED[name]
    kinds = [name.partition(".")[0].split()[0]]
    kinds = (
        kinds if kinds[0] in _PROFILES and "of colors" not in name else ["Display P3", "swapped"]
    )
    for kind in kinds:
        path = tmp_path / name
        Image.fromarray(_COLORS).convert(mode).save(path, icc_profile=_PROFILES[kind], **settings)
        opened: Any = Image.open(path)
        plain = opened.convert(kind if kind == "CMYK" else mode[0] if mode == "LA" else mode)
        plain = plain.convert("RGB") if mode in ("RGBA", "P") or "of colors" in name else plain
        right = _of_lcms(plain, _PROFILES[kind])
        assert np.abs(read_rgb(path) - right).max() <= 1, kind
        assert np.abs(read_rgb(opened) - right).max() <= 1, "Pillow image"
        assert np.abs(np.asarray(plain.convert("RGB"), np.int16) - right).mean() > 1
        stored = np.asarray(opened.convert("RGB"))
        np.testing.assert_array_equal(read_rgb(path, as_stored=True), stored)  # labels


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("gamma", [1.0, 1.8])
def test_profiles_of_16_bits(tmp_path: Path, suffix: str, gamma: float) -> None:
    """Against the formula of sRGB (IEC 61966-2-1)."""
    stored = np.random.default_rng(1).integers(0, 65536, (16, 32, 3)).astype(np.uint16)
    stored[:8] //= 32
    profile, path = _rgb_profile(gamma=gamma), tmp_path / f"a{suffix}"
    if suffix == ".tif":
        tifffile.imwrite(path, stored, iccprofile=profile)
    else:
        chunk = png_chunk(b"iCCP", b"test\0\0" + zlib.compress(profile))
        path.write_bytes(png_bytes(stored, before=chunk))
    light = (stored / 65535) ** gamma
    right = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    found = read_pixels(path, indices=False, in_srgb=True)
    assert found.dtype == np.uint16
    assert np.abs(found / 65535 - right).max() < 2 / 255
    assert np.abs(read_rgb(path) - right * 255).max() < 2.5
    np.testing.assert_array_equal(read_pixels(path, indices=True), stored)


def test_an_srgb_profile_changes_nothing_and_a_broken_one_is_warned_of(tmp_path: Path) -> None:
    image, path = Image.fromarray(_COLORS), tmp_path / "a.png"
    image.save(path, icc_profile=ImageCms.ImageCmsProfile(_SRGB).tobytes())
    np.testing.assert_array_equal(read_rgb(path), _COLORS)
    for profile in (b"nonsense", _PROFILES["gray"], _PROFILES["swapped"][:300]):
        image.save(path, icc_profile=profile)
        with pytest.warns(UserWarning, match=r"a\.png: found a color profile that cannot be used"):
            np.testing.assert_array_equal(read_rgb(path), _COLORS)


def _natural(columns: int) -> Image.Image:
    rng, size = np.random.default_rng(3), (columns, columns // 2)
    waves = (rng.normal(0, 2.0 ** (7 - k), (2**k, 2 ** (k + 1), 3)) for k in range(1, 7))
    sums: Any = sum(
        np.kron(w, np.ones((size[1] // len(w), size[0] // w.shape[1], 1))) for w in waves
    )
    return Image.fromarray((sums + 128).clip(0, 255).astype(np.uint8))


_DAMAGES = ("second half", "no end", "cut", "middle")


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        *product((".jpg", ".png", ".avif"), _DAMAGES),
        *product((".webp", ".heic"), _DAMAGES[:3]),  # without a checksum, some damage decodes
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, suffix: str, damage: str) -> None:
    path = tmp_path / f"a{suffix}"
    _natural(256).save(path)
    content = path.read_bytes()
    half = len(content) // 2
    read_rgb(path)
    wrong = {
        "second half": content[:half] + bytes(len(content) - half),
        "middle": content[:half] + bytes(24) + content[half + 24 :],
        "no end": content[:-2] if suffix == ".jpg" else content[:-9],
        "cut": content[:half],
    }
    path.write_bytes(wrong[damage])
    with pytest.raises(DataError, match=rf"a\{suffix}: found no image that can be decoded"):
        read_rgb(path)


def test_photos_with_something_behind_their_end_are_read(tmp_path: Path) -> None:
    """Motion photos append a video; odd headers are no damage."""
    image, path = _natural(128), tmp_path / "a.jpg"
    image.save(path, quality=95, progressive=True)
    content, right = path.read_bytes(), np.asarray(Image.open(path))
    for odd in (
        content + bytes(1000) + b"\0\0\0\x18ftypmp42",
        content.replace(b"JFIF\0\1", b"JFIF\0\7"),
    ):
        path.write_bytes(odd)
        np.testing.assert_array_equal(read_rgb(path), right)
