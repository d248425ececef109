"""XMP data of images: the properties of a namespace (XMP specification, parts 1 and 3)."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_metadata

_HEAD = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION_HEAD = b"http://ns.adobe.com/xmp/extension/\0"
_NAME_END, _SIZE_END, _OFFSET_END = (len(_EXTENSION_HEAD) + n for n in (32, 36, 40))
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_VALUE = f"{_RDF}value"


def read_properties(path: Path, namespace: str) -> dict[str, str]:
    """Read the simple properties of a namespace from the XMP data of an image.

    A property may have any prefix, and may be an attribute or an element, with qualifiers or
    without. Properties of structures are ignored: they may describe another image.

    Args:
        path: Image file; arrays and OpenEXR images have no XMP data.
        namespace: URI of the namespace.

    Returns:
        Values by local name.

    Raises:
        DataError: The file cannot be read, or XMP data with this namespace are not XML.
    """
    found: dict[str, str] = {}
    for packet in _packets(path):
        try:
            found = _properties(packet.lstrip(), namespace) | found
        except (SyntaxError, ValueError, LookupError) as error:
            if namespace.encode() in packet.replace(b"\0", b""):  # also of UTF-16
                raise _unreadable(path, error) from error
    return found


def _unreadable(path: Path, error: Exception) -> DataError:
    return DataError(
        path,
        found=f"XMP data that cannot be read ({error})",
        expected="XML without a document type",
        remedy="Write the tags again, or remove them: exiftool -XMP:all= <file>.",
    )


def _packets(path: Path) -> list[bytes]:
    """Return the XMP packets of an image: the main packet, then its extensions."""
    info, segments = read_metadata(path)
    main = info.get("xmp") or info.get("XML:com.adobe.xmp") or b""
    packets = [main.encode() if isinstance(main, str) else main]
    # ImageMagick writes a line with the name, one with the length, and hexadecimal digits.
    for kind in ("xmp", "APP1"):
        text = info.get(f"Raw profile type {kind}", "")
        try:
            content = bytes.fromhex("".join(text.split("\n")[3:]))
        except ValueError as error:
            raise _unreadable(path, error) from error
        packets.append(b"" if content.startswith(b"Exif") else content.removeprefix(_HEAD))
    extensions: dict[bytes, list[tuple[bytes, bytes]]] = {}
    for segment in segments:
        if segment.startswith(_EXTENSION_HEAD):
            name = segment[len(_EXTENSION_HEAD) : _NAME_END]
            part = segment[_SIZE_END:_OFFSET_END], segment[_OFFSET_END:]
            extensions.setdefault(name, []).append(part)
    named = [parts for name, parts in extensions.items() if name in packets[0]]
    packets += [b"".join(content for _, content in sorted(parts)) for parts in named]
    return [packet for packet in packets if packet]


def _properties(packet: bytes, namespace: str) -> dict[str, str]:
    values: dict[str, str] = {}
    for node in (node for rdf in _root(packet).iter(f"{_RDF}RDF") for node in rdf):
        values |= node.attrib
        for element in node:
            parts = [element, *element.findall(f"{_RDF}Description")]  # with qualifiers or without
            found = (part.get(_VALUE) or part.findtext(_VALUE) for part in parts)
            values[element.tag] = next(filter(None, found), element.text or "")
    start = f"{{{namespace}}}"
    return {
        name.removeprefix(start): value.strip()
        for name, value in values.items()
        if name.startswith(start)
    }


def _root(packet: bytes) -> ElementTree.Element:
    """Return the outermost element; padding after it is ignored."""
    if b"<!DOCTYPE" in packet.replace(b"\0", b""):  # it could define entities that grow
        raise ValueError("a document type")
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    parser.feed(packet)
    root: ElementTree.Element | None = None
    for event, element in parser.read_events():
        if root is None:
            root = element
        elif event == "end" and element is root:
            return root
    raise ValueError("truncated")
