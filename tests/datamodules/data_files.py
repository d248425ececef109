"""Files of data sets, and the names in their splits."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from datamodules.core.data_module import DataModule
from datamodules.core.files import Split
from tangent_train.rendering.resampling import resize

GPANO_TAGS = {
    "ProjectionType": "equirectangular",
    "FullPanoWidthPixels": "360",
    "FullPanoHeightPixels": "180",
    "CroppedAreaImageWidthPixels": "60",
    "CroppedAreaImageHeightPixels": "40",
    "CroppedAreaLeftPixels": "100",
    "CroppedAreaTopPixels": "30",
}
"""40×60 pixels of a panorama of 180×360."""


def write_png(path: Path, image: NDArray[Any]) -> None:
    """Write an image in OpenCV's order of colors."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def read_png(path: Path) -> NDArray[Any]:
    """Read an image as it is stored, in OpenCV's order of colors."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def nearest_valid(depth: NDArray[np.uint16], shape: tuple[int, int]) -> NDArray[np.uint16]:
    """Reduce depth slowly: look at every source pixel of every footprint."""
    out = resize(depth, shape, "nearest").copy()
    (H, W), (h, w) = depth.shape, shape
    for i, j in np.ndindex(h, w):
        top, bottom, left, right = i * H / h, (i + 1) * H / h, j * W / w, (j + 1) * W / w
        inside = [
            (np.hypot(y + 0.5 - (top + bottom) / 2, x + 0.5 - (left + right) / 2), depth[y, x])
            for y in range(int(top), min(math.ceil(bottom) + 1, H))
            for x in range(int(left), min(math.ceil(right) + 1, W))
            if top <= y + 0.5 <= bottom and left <= x + 0.5 <= right and depth[y, x]
        ]
        if out[i, j] == 0 and inside:
            out[i, j] = min(inside, key=lambda pair: pair[0])[1]
    return out


def png_bytes(
    pixels: NDArray[np.unsignedinteger], before: bytes = b"", behind: bytes = b""
) -> bytes:
    """A PNG file of ``(H, W[, C])`` with chunks before and behind its pixels, byte by byte."""
    height, width = pixels.shape[:2]
    channels = pixels.size // height // width
    rows = pixels.astype(pixels.dtype.newbyteorder(">")).reshape(height, -1)
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(
        ">IIBBBBB", width, height, 8 * pixels.itemsize, (0, 4, 2, 6)[channels - 1], 0, 0, 0
    )
    parts = [png_chunk(b"IHDR", header), before, png_chunk(b"IDAT", zlib.compress(data)), behind]
    return b"\x89PNG\r\n\x1a\n" + b"".join([*parts, png_chunk(b"IEND", b"")])


def png_chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    check = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", check)


def exif_orientation(orientation: int) -> bytes:
    """EXIF data with one tag."""
    return b"MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHIHHI", 274, 3, 1, orientation, 0, 0)


def as_displayed(stored: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return pixels as displayed, by EXIF position of first row and column (CIPA DC-008)."""
    row_side, column_side = ("tl", "tr", "br", "bl", "lt", "rt", "rb", "lb")[orientation - 1]
    shown = stored if row_side in "tb" else stored.swapaxes(0, 1)
    if "r" in (row_side, column_side):
        shown = shown[:, ::-1]
    return shown[::-1] if "b" in (row_side, column_side) else shown


def tiff_bytes(
    pixels: NDArray[Any], order: Any = "<", tags: Mapping[int, Any] = {}, *, big: bool = False
) -> bytes:
    """A TIFF file of ``(H, W[, C])`` in one strip, byte by byte; of planes, one strip each.

    Args:
        pixels: Its pixels.
        order: Byte order.
        tags: Other tags, all 16-bit numbers. 284: planes; 259: 8 of a compressed file; 266: 2 of
            reversed bits.
        big: BigTIFF.
    """
    height, width = pixels.shape[:2]
    channels = pixels.size // height // width
    stored = pixels.reshape(height, width, channels).astype(pixels.dtype.newbyteorder(order))
    planes = np.moveaxis(stored, -1, 0) if tags.get(284) == 2 else [stored]
    strips = [np.ascontiguousarray(plane).tobytes() for plane in planes]
    if tags.get(266) == 2:
        strips = [bytes(int(f"{byte:08b}"[::-1], 2) for byte in strip) for strip in strips]
    if tags.get(259) == 8:
        strips = [zlib.compress(strip) for strip in strips]
    size, head, entry = (8, 16, 20) if big else (4, 8, 12)
    places = np.cumsum([head, *map(len, strips)]).tolist()
    bits = [8 * pixels.itemsize] * channels
    shorts: dict[int, Any] = {256: width, 257: height, 258: bits, 277: channels, 278: height}
    shorts |= {259: 1, 262: 1 if channels < 3 else 2, **tags}
    values = {tag: np.array(value, f"{order}u2") for tag, value in shorts.items()}
    values |= {273: np.array(places[:-1], f"{order}u4")}
    values |= {279: np.array([len(strip) for strip in strips], f"{order}u4")}
    count, start = ("Q", "HHQ") if big else ("H", "HHI")
    behind = places[-1] + struct.calcsize(f"={count}") + entry * len(values) + size
    entries, extra = b"", b""
    for tag, value in sorted(values.items()):
        content = value.tobytes()
        if len(content) > size:
            extra, content = extra + content, (behind + len(extra)).to_bytes(size, _NAMES[order])
        kind = {2: 3, 4: 4}[value.itemsize]
        entries += struct.pack(f"{order}{start}", tag, kind, value.size) + content.ljust(
            size, b"\0"
        )
    magic = {"<": b"II", ">": b"MM"}[order]
    magic += struct.pack(f"{order}HHH", 43, 8, 0) if big else struct.pack(f"{order}H", 42)
    directory = struct.pack(f"{order}{count}", len(values)) + entries + bytes(size)
    first = places[-1].to_bytes(size, _NAMES[order])
    return b"".join([magic, first, *strips, directory, extra])


_NAMES: Mapping[str, Any] = {"<": "little", ">": "big"}


def gpano_xmp(tags: Mapping[str, object]) -> bytes:
    """XMP data with GPano tags as attributes."""
    listed = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    return xmp_packet(f"<rdf:Description {listed}/>")


def xmp_packet(content: str, prefix: str = "GPano") -> bytes:
    """An XMP packet of RDF, with the namespace of the GPano tags under a prefix."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
        f' xmlns:{prefix}="http://ns.google.com/photos/1.0/panorama/">'
        f'{content}</rdf:RDF></x:xmpmeta>\n <?xpacket end="w"?>'
    ).encode()


def contents(root: Path) -> dict[str, bytes]:
    """All files of a folder, by their names relative to it."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def names_of(module: DataModule, split: Split) -> list[str]:
    """Names of the samples of a split."""
    source: Any = module.dataset(split)
    return [source.name(index) for index in range(len(source))]


def hide_start(path: Path, seconds: float) -> None:
    """Begin the edit list later (ISO 14496-12, 8.6.6), as a cut without encoding does."""
    import av

    with av.open(str(path)) as container:
        ticks = round(seconds / float(container.streams.video[0].time_base or 1))
    data = bytearray(path.read_bytes())
    place = data.index(b"elst") + 12
    duration, start = struct.unpack_from(">Ii", data, place)
    struct.pack_into(">Ii", data, place, duration, start + ticks)
    path.write_bytes(data)


def save_tagged(path: Path, tags: Mapping[str, str], shape: tuple[int, int] = (40, 60)) -> Path:
    """Save a black image with GPano tags."""
    xmp = gpano_xmp(tags)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    formats: dict[str, Any] = {".png": {"pnginfo": text}, ".tif": {"tiffinfo": {700: xmp}}}
    settings = formats.get(path.suffix, {"xmp": xmp})
    Image.new("RGB", (shape[1], shape[0])).save(path, **settings)
    return path


def stereo_box(mode: int) -> bytes:
    """The box ``st3d`` of Spherical Video V2: 0 mono, 1 top-bottom, 2 left-right, 4 right-left."""
    return _box(b"st3d", bytes(4), bytes([mode]))


def projection_boxes(
    kind: bytes,
    pose_deg: tuple[float, float, float] = (0, 0, 0),
    cropped: tuple[float, float, float, float] = (0, 0, 0, 0),
) -> bytes:
    """The box ``sv3d``: yaw, pitch, roll; shares cropped at the top, bottom, left and right."""
    header = struct.pack(">4x3i", *(round(angle * 2**16) for angle in pose_deg))
    content = struct.pack(">4x4I", *(round(share * 2**32) for share in cropped))
    projection = _box(b"proj", _box(b"prhd", header), _box(kind, content))
    return _box(b"sv3d", _box(b"svhd", bytes(5)), projection)


def _box(name: bytes, *content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + sum(map(len, content)), name) + b"".join(content)


_SAMPLE_ENTRY = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"")


def spherical_v1(tags: Mapping[str, str]) -> bytes:
    """The box of Spherical Video V1."""
    listed = "".join(f"<GSpherical:{name}>{v}</GSpherical:{name}>" for name, v in tags.items())
    xml = (
        '<?xml version="1.0"?><rdf:SphericalVideo'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
        f' xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">{listed}'
        "</rdf:SphericalVideo>"
    )
    return _box(b"uuid", bytes.fromhex("ffcc8263f8554a938814587a02521fdd"), xml.encode())


def insert_boxes(path: Path, new: bytes, parents: Sequence[bytes] = _SAMPLE_ENTRY) -> None:
    """Insert boxes at the end of a box of an MP4 file, whose moov box is its last."""
    data, place, starts = bytearray(path.read_bytes()), 0, []
    for name in parents:
        while name and bytes(data[place + 4 : place + 8]) != name:
            place += struct.unpack_from(">I", data, place)[0]
        starts.append(place)
        place += 16 if name == b"stsd" else 8
    end = starts[-1] + struct.unpack_from(">I", data, starts[-1])[0]
    data[end:end] = new
    for start in starts:
        struct.pack_into(">I", data, start, struct.unpack_from(">I", data, start)[0] + len(new))
    path.write_bytes(data)
