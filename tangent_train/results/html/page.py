"""Write a report as one self-contained HTML file, with compressed panoramas and photos."""

from __future__ import annotations

import html
import json
import re
from base64 import b64encode
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.files import atomic_path
from tangent_train.geometry import equirect_solid_angles
from tangent_train.io.palette import class_colors, distance_colors
from tangent_train.results.html.distances import DistanceScale, camera_in_sides, pack_distances
from tangent_train.results.tables import Table

MOST_PIXELS = 4096
"""The longer side of an image in the report."""

_MOST_DISTANCES = 2048
_THUMBNAIL_PIXELS = 216
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 88)
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 6)

_SCRIPTS = ("view.js", "distances.js", "surfaces.js", "gestures.js", "viewer.js")
_SCRIPT = '<script>\n"use strict";\n{{\n{}}}\n</script>'
"""Block of the scripts, whose names are not in the page's global scope."""

_IMAGES = "<!--images-->\n"
_PLACEHOLDER = re.compile(r"\{\{(\w+)\}\}")


class EncodedImage(NamedTuple):
    """A compressed image of the viewer, with maps of labels or distances; see `encode_image`.

    Attributes:
        name: Name in the list of images.
        note: Line below the name, e.g. a score.
        sphere: True for a panorama; False for an image that is shown flat.
        width: Columns of the image before compression.
        height: Rows of the image before compression.
        input: JPEG of the image.
        thumbnail: Small JPEG of the image.
        prediction: 8-bit gray PNG of predicted labels, or RGB PNG of distances, which may have
            fewer pixels.
        truth: The same of the truth.
        shares: ``(label, share of the truth, share of the prediction)`` of the labels that occur,
            without shares of missing maps; by solid angle for panoramas.
        scale: Scale of the distances; None for labels.
    """

    name: str
    note: str
    sphere: bool
    width: int
    height: int
    input: bytes
    thumbnail: bytes
    prediction: bytes | None
    truth: bytes | None
    shares: tuple[tuple[float, ...], ...]
    scale: DistanceScale | None = None


def encode_image(
    name: str,
    rgb: NDArray[np.uint8],
    class_count: int = 0,
    *,
    prediction: NDArray[Any] | None = None,
    truth: NDArray[Any] | None = None,
    is_metric: bool = True,
    camera_matrix: NDArray[np.float64] | None = None,
    sphere: bool = True,
    note: str = "",
) -> EncodedImage:
    """Compress an image for the report, to a few megabytes at most.

    Images whose longer side exceeds `MOST_PIXELS` are downsampled: colors by area averaging, labels
    by nearest neighbor. Distances, which compress less, have at most 2048.

    Args:
        name: Name in the list of images.
        rgb: Image ``(H, W, 3)``.
        class_count: Number of labels, K + 1, with the unknown class 0; at most 256. 0 for
            distances.
        prediction: Predicted labels ``(h, w)``, which may have another size than the image; or
            distances from the center, which are z-depth with `camera_matrix`.
        truth: True labels or distances ``(h, w)``; 0 and NaN are unknown.
        is_metric: True for distances in meters; False for distances up to a scale.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centers, for points.
        sphere: True for a panorama.
        note: Line below the name.
    """
    side, dtype = (MOST_PIXELS, np.uint8) if class_count else (_MOST_DISTANCES, np.float32)
    packed = {
        key: _shrunk(array.astype(dtype, copy=False), side, cv2.INTER_NEAREST_EXACT)
        for key, array in (("truth", truth), ("prediction", prediction))
        if array is not None
    }
    scale = None
    shares: tuple[tuple[float, ...], ...] = ()
    if class_count:
        shares = _shares(list(packed.values()), class_count, sphere=sphere)
    elif packed:
        camera = None if camera_matrix is None else camera_in_sides(camera_matrix, rgb.shape)
        scale, packed = pack_distances(packed, camera, sphere=sphere, is_metric=is_metric)
    pngs = {key: cv2.imencode(".png", array, _PNG)[1].tobytes() for key, array in packed.items()}
    jpeg, thumbnail = _jpeg(rgb, MOST_PIXELS), _jpeg(rgb, _THUMBNAIL_PIXELS)
    height, width = rgb.shape[:2]
    both = pngs.get("prediction"), pngs.get("truth")
    return EncodedImage(name, note, sphere, width, height, jpeg, thumbnail, *both, shares, scale)


def _shrunk(pixels: NDArray[Any], side: int, interpolation: int) -> NDArray[Any]:
    """Downsample an image so that its longer side has at most `side` pixels."""
    scale = side / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    height, width = (max(1, round(length * scale)) for length in pixels.shape[:2])
    resized: NDArray[Any] = cv2.resize(pixels, (width, height), interpolation=interpolation)
    return resized


def _jpeg(rgb: NDArray[np.uint8], side: int) -> bytes:
    bgr = cv2.cvtColor(_shrunk(rgb, side, cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, _JPEG)[1].tobytes()


def _shares(
    maps: Sequence[NDArray[np.uint8]], class_count: int, *, sphere: bool
) -> tuple[tuple[float, ...], ...]:
    shares = []
    for indices in maps:
        # Row by row, without an array of weights as large as the image.
        counts = np.stack([np.bincount(row, minlength=class_count) for row in indices])
        height, width = indices.shape
        weights = equirect_solid_angles((height, width)) if sphere else np.ones(height)
        weighed = weights.reshape(-1) @ counts
        shares.append(weighed / weighed.sum())
    return tuple((k, *map(float, of)) for k, of in enumerate(zip(*shares, strict=True)) if any(of))


def write_report(
    path: Path,
    title: str,
    *,
    tables: Sequence[Table] = (),
    images: Sequence[EncodedImage] = (),
    class_names: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> None:
    """Write a report as one HTML file, atomically.

    Args:
        path: File to write.
        title: Title of the page.
        tables: Tables below the viewer.
        images: Images in the viewer.
        class_names: Names of the K + 1 labels, the unknown class first.
        notes: Lines below the title, the most important first.
    """
    parts: dict[str, str] = {
        "title": html.escape(title),
        "notes": "\n".join(f"<p>{html.escape(note)}</p>" for note in notes),
        "style": _resource("viewer.css"),
        "viewer": _viewer(class_names) if images else "",
        "script": _SCRIPT.format("\n".join(map(_resource, _SCRIPTS))) if images else "",
        "tables": "\n".join(table.html() for table in tables),
    }
    page = _filled(_resource("page.html"), parts)
    before, _, after = page.partition(_IMAGES)
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.write(before)
        for image in images:
            _write_image(file, image)
        file.write(after)


def _viewer(class_names: Sequence[str]) -> str:
    colors = class_colors(len(class_names)).tolist()[: len(class_names)]  # empty without classes
    classes = [{"name": name, "rgb": rgb} for name, rgb in zip(class_names, colors, strict=True)]
    parts = {
        "images": _IMAGES,
        "classes": _json(classes),
        "distances": _json(distance_colors().tolist()),
        "shader": _resource("viewer.glsl"),
    }
    return _filled(_resource("viewer.html"), parts)


def _write_image(file: TextIO, image: EncodedImage) -> None:
    note = f'<span class="note">{html.escape(image.note)}</span>' if image.note else ""
    file.write(
        f'<li><button type="button"><img alt="" src="data:image/jpeg;base64,'
        f'{_base64(image.thumbnail)}"><span class="name">{html.escape(image.name)}</span>{note}'
        '</button>\n<script type="application/json">'
    )
    content = image._asdict() | {"scale": image.scale and image.scale._asdict()}
    del content["thumbnail"]
    file.write(f"{_json(content)}</script></li>\n")


def _json(content: Any) -> str:
    """Return JSON that can neither end the script element around it nor start a comment in it."""
    text = json.dumps(content, separators=(",", ":"), default=_base64)
    return text.replace("<", "\\u003c")


def _base64(content: bytes) -> str:
    return b64encode(content).decode("ascii")


def _filled(template: str, parts: dict[str, str]) -> str:
    """Replace the ``{{names}}`` of a template; inserted text is not scanned again."""
    return _PLACEHOLDER.sub(lambda match: parts[match[1]], template)


def _resource(name: str) -> str:
    return files("tangent_train.results.html").joinpath(name).read_text(encoding="utf-8")
