"""XMP data of images: the properties of a namespace (XMP specification, parts 1 and 3)."""

from __future__ import annotations

from pathlib import Path
from xml.parsers import expat

from datamodules.images.pixel_files import read_metadata
from tangent_train.errors import DataError

_HEAD = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION_HEAD = b"http://ns.adobe.com/xmp/extension/\0"
_NAME_END, _SIZE_END, _OFFSET_END = (len(_EXTENSION_HEAD) + n for n in (32, 36, 40))
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_ROOT, _DESCRIPTION, _VALUE = (f"{_RDF} {name}" for name in ("RDF", "Description", "value"))


def read_properties(path: Path, namespace: str) -> dict[str, str]:
    """Read the simple properties of a namespace from the XMP data of an image.

    Prefixes do not matter, nor whether a property is an attribute or an element, with qualifiers or
    without. Properties of structures, such as those of an image that this one was made from, do not
    count.

    Args:
        path: An image; arrays and OpenEXR images have no XMP data.
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
        except (expat.ExpatError, ValueError) as error:
            if namespace.encode() in packet.replace(b"\0", b""):  # also of UTF-16
                raise DataError(
                    path,
                    found=f"XMP data that cannot be read ({error})",
                    expected="XML without a document type",
                    remedy="Write the tags again, or remove them: exiftool -XMP:all= <file>.",
                ) from error
    return found


def _packets(path: Path) -> list[bytes]:
    """The XMP packets of an image: the main one, then those that it names as its extension."""
    info, segments = read_metadata(path)
    main = info.get("xmp") or info.get("XML:com.adobe.xmp") or b""
    packets = [main.encode() if isinstance(main, str) else main]
    # ImageMagick writes a line with the name, one with the length, and hexadecimal digits.
    for kind in ("xmp", "APP1"):
        text = info.get(f"Raw profile type {kind}", "")
        content = bytes.fromhex("".join(text.split("\n")[3:]))
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
    reader = _Reader(namespace)
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.StartDoctypeDeclHandler = _refuse_doctype
    parser.StartElementHandler = reader.start
    parser.CharacterDataHandler = reader.add_text
    parser.EndElementHandler = reader.end
    try:
        parser.Parse(packet, True)
    except expat.ExpatError:
        if not reader.is_done:  # else it is what fills the packet
            raise
    return reader.values


def _refuse_doctype(*_: object) -> None:
    # It could define entities that grow without end.
    raise ValueError("a document type")


class _Reader:
    """Collects properties while RDF is parsed: ``RDF``, in it nodes, in these properties.

    Attributes:
        values: Values by local name.
        is_done: True after the outermost element.
    """

    def __init__(self, namespace: str) -> None:
        self.values: dict[str, str] = {}
        self.is_done = False
        self._prefix = f"{namespace} "
        self._tags: list[str] = []
        self._text = ""

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Begin an element."""
        self._tags.append(tag)
        if self._tags[-2:-1] == [_ROOT]:
            for name, value in attributes.items():
                self._keep(name, value)
        elif self._in_property() or tag == _DESCRIPTION:
            self._text = attributes.get(_VALUE, "")

    def add_text(self, text: str) -> None:
        """Take text of a property, or of the value beside its qualifiers."""
        if self._in_property() or self._tags[-1] == _VALUE:
            self._text += text

    def end(self, tag: str) -> None:
        """End an element."""
        if self._in_property():
            self._keep(tag, self._text)
        self._tags.pop()
        self.is_done = not self._tags

    def _in_property(self) -> bool:
        return self._tags[-3:-2] == [_ROOT]

    def _keep(self, name: str, value: str) -> None:
        if name.startswith(self._prefix):
            self.values[name.removeprefix(self._prefix)] = value.strip()
