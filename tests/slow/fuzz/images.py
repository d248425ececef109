"""Readers of images and of what is written in them; valid files to break, what has to come out."""

from __future__ import annotations

import functools
import zlib
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import OpenEXR
from PIL import Image

from datamodules.core.label_table import CLASSES, LabelTable
from datamodules.images.gpano import NAMESPACE, area_of
from datamodules.images.gpano_pose import up_of
from datamodules.images.image_files import read_depth_m
from datamodules.images.pixel_files import read_pixels
from datamodules.images.png import check_png, read_color_png, read_depth_png
from tangent_train.errors import DataError
from tests.slow.fuzz.mutation import png_chunk
from tests.slow.fuzz.pixels import DEPTH, RGB, npy, png

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "picture_seeds",
    "pixel_seeds",
    "read_image",
    "read_picture",
    "read_xmp",
    "scanlines",
    "xmp_part",
    "xmp_seeds",
]

_TABLE = LabelTable(np.arange(14, dtype=np.uint8))


def picture_seeds() -> list[bytes]:
    indices = np.zeros_like(RGB)
    indices[..., 2] = RGB[..., 2] % 20
    alpha = np.dstack([indices, indices[..., :1]])
    return [png(indices), png(alpha), png(indices, optimize=True), png(DEPTH)]


def scanlines(content: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    """The pixels of a PNG file as they are packed."""
    start = content.find(b"IDAT")
    end = start + 4 + int.from_bytes(content[start - 4 : start], "big")

    def put(lines: bytes) -> bytes:
        return content[: start - 4] + png_chunk(b"IDAT", zlib.compress(lines)) + content[end + 4 :]

    try:
        return zlib.decompress(content[start + 4 : end]), put
    except zlib.error:
        return None


def _read_labels(path: Path) -> None:
    header = check_png(path, 8, ("RGB", "RGBA"))
    labels = _TABLE.decode(read_color_png(path))
    assert labels.shape == header[:2]
    assert labels.max() <= len(CLASSES)


def _read_depth(path: Path) -> None:
    header = check_png(path, 16, ("grey",))
    depth = read_depth_png(path)
    assert depth.shape == header[:2]
    assert depth.dtype == np.uint16


def read_picture(path: Path) -> None:
    with path.open("rb") as file:
        start = file.read(25)
    (_read_depth if start[24:] == b"\x10" else _read_labels)(path)


_HEAD = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><r:RDF xmlns:r="rdf"><r:Description xmlns:GPano="'
_TAGS = {
    "ProjectionType": b"equirectangular",
    "FullPanoWidthPixels": b"360",
    "FullPanoHeightPixels": b"180",
    "CroppedAreaImageWidthPixels": b"60",
    "CroppedAreaImageHeightPixels": b"40",
    "CroppedAreaLeftPixels": b"100",
    "CroppedAreaTopPixels": b"30",
    "PosePitchDegrees": b"-3.5",
    "PoseRollDegrees": b"12",
}


def xmp_seeds() -> list[bytes]:
    start, tail = _HEAD + NAMESPACE.encode(), b"</r:RDF></x:xmpmeta>"
    listed = b" ".join(b'GPano:%b="%b"' % (name.encode(), v) for name, v in _TAGS.items())
    attributes = start + b'" ' + listed + b"/>" + tail
    told = b"".join(
        b"<GPano:%b>%b</GPano:%b>" % (n.encode(), v, n.encode()) for n, v in _TAGS.items()
    )
    elements = start + b'">' + told + b"</r:Description>" + tail
    seeds = [
        _with_xmp(text, packed) for text in (attributes, elements) for packed in (b"\0", b"\1")
    ]
    for kind, options in (("jpeg", {}), ("webp", {}), ("tiff", {"tiffinfo": {700: attributes}})):
        file = BytesIO()
        xmp: dict[str, Any] = options or {"xmp": attributes}
        Image.new("RGB", (60, 40)).save(file, kind, **xmp)
        seeds.append(file.getvalue())
    return seeds


@functools.cache
def _plain() -> bytes:
    return png(np.zeros((40, 60), np.uint8))


def _with_xmp(text: bytes, packed: bytes) -> bytes:
    written = zlib.compress(text, 1) if packed == b"\1" else text
    chunk = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0" + packed + b"\0\0\0" + written)
    return _plain()[:33] + chunk + _plain()[33:]


def xmp_part(content: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    if content[37:41] != b"iTXt":
        return None
    packed = content[59:60]
    text = content[63 : 41 + int.from_bytes(content[33:37], "big")]
    if packed == b"\1":
        try:
            text = zlib.decompress(text)
        except zlib.error:
            return None
    return text, functools.partial(_with_xmp, packed=packed)


def read_xmp(path: Path) -> None:
    up = up_of(path)
    assert up is None or abs(np.linalg.norm(up) - 1) < 1e-9
    area = area_of(path, (40, 60))
    if area is not None:
        rows, columns = area.places()
        assert (len(rows), len(columns)) == area.image_shape
        assert 0 <= rows.min() <= rows.max() < area.full_shape[0] <= 16384
        assert 0 <= columns.min() <= columns.max() < area.full_shape[1] == 2 * area.full_shape[0]


def pixel_seeds() -> list[bytes]:
    rgb, alpha = Image.fromarray(RGB), Image.fromarray(np.dstack([RGB, RGB[..., :1]]))
    grey = rgb.convert("L")
    images = [("png", rgb), ("png", rgb.convert("P")), ("png", grey.convert("LA")), ("webp", rgb)]
    images += [("jpeg", rgb), ("webp", alpha), ("tiff", rgb), ("tiff", grey.convert("1"))]
    images += [("png", Image.fromarray(DEPTH)), ("tiff", Image.fromarray(DEPTH))]
    images += [("tiff", Image.fromarray(DEPTH.astype(np.float32)))]
    seeds = [npy(DEPTH), npy(RGB), npy(DEPTH.astype(np.float32))]
    for kind, image in images:
        file = BytesIO()
        exif = Image.Exif()
        exif[0x0112] = 6
        image.save(file, kind, **({"exif": exif} if kind in ("jpeg", "png", "webp") else {}))
        seeds.append(file.getvalue())
    deep = cv2.imencode(".png", np.dstack([DEPTH] * 4))[1].tobytes()
    packed = cv2.imencode(".tiff", np.dstack([DEPTH] * 3))[1].tobytes()
    return [*seeds, deep, packed, *map(_exr, ("NO", "ZIP", "PIZ"))]


def _exr(packed: str) -> bytes:
    compression = OpenEXR.Compression.__members__[f"{packed}_COMPRESSION"]
    header = {"type": OpenEXR.scanlineimage, "compression": compression}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        OpenEXR.File(header, {"Z": DEPTH.astype(np.float32)}).write(str(path))
        return path.read_bytes()


def read_image(path: Path) -> None:
    suffix = {b"\x93": ".npy", b"P": ".npy", b"\x76": ".exr"}.get(path.read_bytes()[:1], ".png")
    path = path.replace(path.with_suffix(suffix))
    for indices in (True, False):
        pixels = read_pixels(path, indices=indices)
        assert pixels.ndim in (2, 3)
        assert pixels.dtype.kind in "buif"
        assert 0 not in pixels.shape
    with suppress(DataError):  # colours are none
        depth = read_depth_m(path, 1000.0)
        assert 0 <= depth.min() <= depth.max() <= 1e4
