"""XMP data of images: what programs have written into a file about it, as XML."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, BinaryIO
from xml.parsers import expat

from datamodules.images.image_opening import open_image
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["read_xmp_tags"]

_PNG_KEYWORD = b"XML:com.adobe.xmp"
_MOST_BYTES = 1 << 24


def read_xmp_tags(path: Path, namespace: str) -> dict[str, str]:
    """The tags of one namespace, whether they are written as attributes or as elements.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        namespace: Its address.

    Returns:
        Values by the names of the tags; none where there are no XMP data, or broken ones.

    Raises:
        DataError: The file cannot be read, or the XMP data declare entities.
    """
    with open_image(path) as image:
        xmp = image.info.get("xmp")
        is_png = image.format == "PNG"
    if is_png:
        # Programs may write it behind the pixels, where Pillow finds it only by decoding them.
        with path.open("rb") as file:
            xmp = _png_xmp(file)
    if not xmp:
        return {}
    return _parse(path, xmp.encode() if isinstance(xmp, str) else bytes(xmp), namespace)


def _png_xmp(file: BinaryIO) -> bytes | None:
    """The text chunk with XMP data, wherever it is."""
    file.seek(8)
    while len(head := file.read(8)) == 8:
        size, kind = int.from_bytes(head[:4], "big"), head[4:]
        if kind == b"iTXt" and size <= _MOST_BYTES:
            keyword, _, rest = file.read(size).partition(b"\0")
            if keyword == _PNG_KEYWORD:
                # Whether it is packed, how; then language, a translated keyword, the text.
                text = rest[2:].split(b"\0", 2)[-1]
                return _unpacked(text) if rest[:1] == b"\1" else text
            file.seek(4, 1)
        else:
            file.seek(size + 4, 1)
    return None


def _unpacked(text: bytes) -> bytes | None:
    try:
        return zlib.decompressobj().decompress(text, _MOST_BYTES)
    except zlib.error:
        return None


def _parse(path: Path, xmp: bytes, namespace: str) -> dict[str, str]:
    tags: dict[str, str] = {}
    texts: dict[str, list[str]] = {}  # in pieces: adding up 16 MB of lines would take minutes
    open_names: list[str] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        open_names.append(name)
        for key, value in attributes.items():
            if key.startswith(namespace):
                tags[key.removeprefix(namespace)] = value.strip()

    def text(content: str) -> None:
        if open_names and open_names[-1].startswith(namespace):
            name = open_names[-1].removeprefix(namespace)
            texts.setdefault(name, []).append(content)

    def refuse(*_: object) -> None:
        raise DataError(
            path,
            found="XMP data with a document type declaration",
            expected="none: its entities could fill the memory",
            remedy="Remove the XMP data, for example with exiftool -xmp:all= <file>.",
        )

    parser = expat.ParserCreate(namespace_separator="")
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_names.pop()
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(_trimmed(xmp), True)
    except DataError:
        raise
    except (expat.ExpatError, LookupError, ValueError):  # broken, or of an unknown encoding
        return {}
    return tags | {name: "".join(pieces).strip() for name, pieces in texts.items()}


def _trimmed(xmp: bytes) -> bytes:
    """Without the padding that XML may not have: zeros behind, white space before."""
    # In UTF-16 zeros are half of the letters.
    return xmp if b"\0" in xmp[:4] else xmp.strip(b"\0 \t\r\n")
