"""Files of data sets, and the names in their splits."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from datamodules.core.found import Split
from datamodules.core.split_module import SplitDataModule

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
    """Write an image in OpenCV's order of colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def read_png(path: Path) -> NDArray[Any]:
    """Read an image as it is stored, in OpenCV's order of colours."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def gpano_xmp(tags: Mapping[str, object], *, elements: bool = False) -> bytes:
    """XMP data with GPano tags as attributes or, beside those of another program, elements."""
    begin = '<r:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
    if elements:
        listed = "".join(f"<GPano:{name}>\n {v}\n</GPano:{name}>" for name, v in tags.items())
        other = "<o:CroppedAreaTopPixels>7</o:CroppedAreaTopPixels>"
        return f"{other}{begin}>{listed}</r:Description>".encode()
    listed = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    return f"{begin} {listed}/>".encode()


def contents(root: Path) -> dict[str, bytes]:
    """All files of a folder, by their names relative to it."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def names_of(module: SplitDataModule[Any], split: Split) -> list[str]:
    """Names of the samples of a split."""
    source: Any = module.source(split)
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
