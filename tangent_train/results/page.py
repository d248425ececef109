"""Write a report as one self-contained HTML file, with compressed panoramas and photos."""

from __future__ import annotations

import json
import re
import shlex
import sys
from base64 import b64encode
from collections.abc import Mapping, Sequence
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.files import write_text
from tangent_train.geometry import equirect_directions, equirect_solid_angles
from tangent_train.heads.pictures import distance_limits
from tangent_train.io.palette import class_colors, distance_colors
from tangent_train.results.tables import Table

MOST_PIXELS = 4096
"""The longer side of an image in the report."""

_MOST_VALUES = 2048
_THUMBNAIL_PIXELS = 216
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 88)
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 6)
_SCRIPTS = ("view.js", "distances.js", "surfaces.js", "gestures.js", "viewer.js")

_STEPS = 65534  # between the nearest and the farthest distance
_FAR = 4  # medians of the distance: points beyond do not count for the middle of the scene
_OUTER = 2, 98  # percentiles of their coordinates


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
        truth: The same of the ground truth.
        confidence: 8-bit gray PNG of the confidence of predicted labels.
        shares: ``(label, share of the truth, share of the prediction)`` of the labels that occur,
            the largest first, without shares of missing maps; by solid angle for panoramas.
        scale: Scale of the distances, see `pack_distances`; None for labels.
        objects: Row of each object in the table by its number, which the PNG of predicted labels
            holds in its green and blue channels (green + 256 blue); None for a gray PNG.
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
    confidence: bytes | None = None
    shares: Sequence[Sequence[float]] = ()
    scale: Mapping[str, Any] | None = None
    objects: Mapping[int, Any] | None = None


def encode_image(
    name: str,
    rgb: NDArray[np.uint8],
    class_count: int = 0,
    *,
    prediction: NDArray[Any] | None = None,
    truth: NDArray[Any] | None = None,
    confidence: NDArray[np.floating] | None = None,
    numbers: NDArray[np.integer] | None = None,
    objects: Mapping[int, Any] | None = None,
    unit: str = "m",
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
        confidence: Confidence ``(h, w)`` of predicted labels, from 0 to 1.
        numbers: Numbers ``(h, w)`` of predicted objects, 0 for none; None without objects.
        objects: Row of each object in the table by its number.
        unit: Unit of the distances, e.g. m, or relative.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centers, for points.
        sphere: True for a panorama.
        note: Line below the name.
    """
    side, dtype = (MOST_PIXELS, np.uint8) if class_count else (_MOST_VALUES, np.float32)
    maps = {
        key: _shrunk(array.astype(dtype, copy=False), side, cv2.INTER_NEAREST_EXACT)
        for key, array in (("truth", truth), ("prediction", prediction))
        if array is not None
    }
    more: dict[str, Any] = {}
    height, width = rgb.shape[:2]
    if class_count:
        shares = np.array([_shares(labels, class_count, sphere=sphere) for labels in maps.values()])
        seen = [(k, *of) for k, of in enumerate(shares.T.tolist()) if any(of)]
        more["shares"] = sorted(seen, key=lambda entry: -max(entry[1:]))
        if numbers is not None:
            shown = _shrunk(numbers.astype(np.uint16), side, cv2.INTER_NEAREST_EXACT)
            blue_first = [shown >> 8, shown & 255, maps["prediction"]]
            maps["prediction"] = np.stack(blue_first, axis=-1).astype(np.uint8)
            more["objects"] = objects
    elif maps:
        camera = None
        if camera_matrix is not None:  # in widths and heights from the upper left corner
            (fx, _, cx), (_, fy, cy), _ = camera_matrix.tolist()
            camera = (fx / width, fy / height, (cx + 0.5) / width, (cy + 0.5) / height)
        more["scale"], maps = pack_distances(maps, camera, sphere=sphere, unit=unit)
    if confidence is not None:
        gray = np.asarray(255 * confidence, np.uint8)
        maps["confidence"] = _shrunk(gray, _MOST_VALUES, cv2.INTER_AREA)
    pngs = {key: cv2.imencode(".png", array, _PNG)[1].tobytes() for key, array in maps.items()}
    more |= {
        key: cv2.imencode(".jpg", _shrunk(rgb, most, cv2.INTER_AREA)[..., ::-1], _JPEG)[1].tobytes()
        for key, most in (("input", MOST_PIXELS), ("thumbnail", _THUMBNAIL_PIXELS))
    }
    more |= {key: pngs.get(key) for key in ("prediction", "truth", "confidence")}
    return EncodedImage(name, note, sphere, width, height, **more)


def _shrunk(pixels: NDArray[Any], side: int, interpolation: int) -> NDArray[Any]:
    """Downsample an image so that its longer side has at most `side` pixels."""
    scale = side / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    height, width = (max(1, round(length * scale)) for length in pixels.shape[:2])
    resized: NDArray[Any] = cv2.resize(pixels, (width, height), interpolation=interpolation)
    return resized


def _shares(labels: NDArray[np.uint8], class_count: int, *, sphere: bool) -> NDArray[np.float64]:
    # Row by row, without an array of weights as large as the image.
    counts = np.stack([np.bincount(row, minlength=class_count) for row in labels])
    height, width = labels.shape
    weights = equirect_solid_angles((height, width)) if sphere else np.ones(height)
    weighed: NDArray[np.float64] = weights.reshape(-1) @ counts
    return weighed / weighed.sum()


def pack_distances(
    distances: Mapping[str, NDArray[np.floating]],
    camera: tuple[float, ...] | None,
    *,
    sphere: bool,
    unit: str,
) -> tuple[dict[str, Any], dict[str, NDArray[np.uint8]]]:
    """Pack maps of distances on one scale, and place the scene of their points.

    Value k of a pixel, 256 red + green, is ``near · (far / near) ** ((k - 1) / 65534)``; 0 is
    unknown. Rounding changes a distance by a factor of at most ``(far / near) ** (1 / 131068)``:
    3.6e-5 of it between 0.1 m and 10 m.

    Args:
        distances: Maps ``(h, w)``, of z-depth with a camera; NaN, infinite and 0 are unknown. The
            last one defines the middle of the scene.
        camera: Focal lengths and principal point of a photo, ``fx, fy, cx, cy``, in widths and
            heights from its upper left corner. None for panoramas, and for photos without a camera
            matrix, which have no points.
        sphere: True for panoramas.
        unit: Unit of the distances.

    Returns:
        Scale: distances of the values 1 (`near`) and 65535 (`far`), of the first and the last color
        (`limits`), `unit` and `camera`, `center` of most points (ahead, right, up) and
        `radius` around it. And images ``(h, w, 3)`` of the packed maps in OpenCV's order.
    """
    maps = {k: np.where(np.isfinite(d) & (d > 0), d, np.nan) for k, d in distances.items()}
    known = np.concatenate([values[values > 0] for values in maps.values()]).astype(np.float64)
    near = float(known.min()) if known.size else 1.0
    far = max(float(known.max(initial=near)), 1.01 * near)
    packed = {}
    for key, values in maps.items():
        steps = np.rint(_STEPS * np.log(values.astype(np.float64) / near) / np.log(far / near)) + 1
        high, low = np.divmod(np.nan_to_num(steps).astype(np.uint16), 256)
        packed[key] = np.stack([0 * low, low, high], axis=-1).astype(np.uint8)
    *_, last = maps.values()
    scale = {"near": near, "far": far, "limits": distance_limits(known)}
    scene = _scene(last, camera) if sphere or camera else {"center": (0, 0, 0), "radius": 1.0}
    return {**scale, "unit": unit, "camera": camera, **scene}, packed


def _scene(distance: NDArray[Any], camera: tuple[float, ...] | None) -> dict[str, Any]:
    """Return middle and radius of most points, without those that are far away, e.g. the sky."""
    shape = distance.shape[0], distance.shape[1]
    if camera is None:
        rays = equirect_directions(shape)
    else:  # ahead, right, up, at z-depth 1
        fx, fy, cx, cy = camera
        right = ((np.arange(shape[1]) + 0.5) / shape[1] - cx) / fx
        up = (cy - (np.arange(shape[0]) + 0.5) / shape[0]) / fy
        rays = np.stack([np.ones(shape), *np.meshgrid(right, up)], axis=-1)
    points = (rays * distance[..., None])[np.isfinite(distance)]
    if not len(points):
        return {"center": (0, 0, 0), "radius": 1.0}
    lengths = np.linalg.norm(points, axis=-1)
    least, most = np.percentile(points[lengths <= _FAR * np.median(lengths)], _OUTER, axis=0)
    center = ((least + most) / 2).tolist()
    return {"center": center, "radius": float(np.linalg.norm(most - least) / 2)}


def write_report(
    path: Path,
    title: str,
    *,
    tables: Sequence[Table] = (),
    images: Sequence[EncodedImage] = (),
    class_names: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> None:
    """Write a report as one HTML file, atomically, with the date and the command.

    Args:
        path: File to write.
        title: Title of the page.
        tables: Tables below the viewer.
        images: Images in the viewer.
        class_names: Names of the K + 1 labels, the unknown class first.
        notes: Lines below the title, the most important first.
    """
    viewer = ""
    if images:
        colors = class_colors(tuple(class_names)).tolist()
        classes = [{"name": n, "rgb": c} for n, c in zip(class_names, colors, strict=False)]
        viewer = _filled(
            "viewer.html",
            images="\n".join(map(_image_entry, images)),
            classes=_json(classes),
            distances=_json(distance_colors().tolist()),
            shader=_resource("viewer.glsl"),
            scripts="\n".join(map(_resource, _SCRIPTS)),
        )
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    notes = [*notes, f"{datetime.now().astimezone():%Y-%m-%d %H:%M} · {command}"]
    page = _filled(
        "page.html",
        title=escape(title),
        notes="\n".join(f"<p>{escape(note)}</p>" for note in notes),
        style=_resource("viewer.css"),
        viewer=viewer,
        tables="\n".join(table.html() for table in tables),
    )
    write_text(path, page)


def _image_entry(image: EncodedImage) -> str:
    note = f'<span class="note">{escape(image.note)}</span>' if image.note else ""
    content = image._asdict()
    thumbnail = _base64(content.pop("thumbnail"))
    return (
        f'<li><button type="button"><img alt="" src="data:image/jpeg;base64,{thumbnail}">'
        f'<span class="name">{escape(image.name)}</span>{note}</button>\n'
        f'<script type="application/json">{_json(content)}</script></li>'
    )


def _json(content: Any) -> str:
    """Return JSON that can neither end the script element around it nor start a comment in it."""
    text = json.dumps(content, separators=(",", ":"), default=_base64)
    return text.replace("<", "\\u003c")


def _base64(content: bytes) -> str:
    return b64encode(content).decode("ascii")


def _filled(name: str, **parts: str) -> str:
    """Replace the ``{{names}}`` of a template; inserted text is not scanned again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _resource(name))


def _resource(name: str) -> str:
    return files("tangent_train.results").joinpath("html", name).read_text(encoding="utf-8")
