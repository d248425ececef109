"""XMP data of images: the properties of a namespace (XMP specification, part 1)."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_xmp

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}RDF"


def read_properties(path: Path, namespace: str) -> dict[str, str]:
    """Read the simple properties of a namespace from the XMP data of an image.

    A property may have any prefix, and may be an attribute or an element. Properties of structures
    are ignored: they may describe another image.

    Args:
        path: Image file; arrays and OpenEXR images have no XMP data.
        namespace: URI of the namespace.

    Returns:
        Values by local name.

    Raises:
        DataError: The file cannot be read, or XMP data with this namespace are not XML.
    """
    packet = read_xmp(path).strip(b"\0 \n")
    if namespace.encode() not in packet:
        return {}
    try:
        if b"<!DOCTYPE" in packet:  # it could define entities that grow
            raise ValueError("a document type")  # noqa: TRY301
        nodes = [node for rdf in ElementTree.fromstring(packet).iter(_RDF) for node in rdf]
    except (SyntaxError, ValueError) as error:
        raise DataError(
            path,
            found=f"XMP data that cannot be read ({error})",
            expected="XML without a document type",
            remedy="Write the tags again, or remove them: exiftool -XMP:all= <file>.",
        ) from error
    values: dict[str, str] = {}
    for node in nodes:
        values |= node.attrib | {child.tag: child.text or "" for child in node}
    start = f"{{{namespace}}}"
    return {
        name.removeprefix(start): value.strip()
        for name, value in values.items()
        if name.startswith(start)
    }
