"""The images that the viewer is tried with, and the comparison with closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.images.palette import class_colors
from tangent_train.geometry import equirect_directions
from tangent_train.results.html import EncodedImage, encode_image
from tests.slow.results.browser import OpenReport

HEIGHT, WIDTH = 251, 503  # odd, no powers of two
PHOTO = (120, 200)
NAMES = ("unknown", *(f"octant {k}" for k in range(1, 8)), "<i>last</i>")
COLORS = class_colors(len(NAMES)).astype(np.int64)
START_DEG, PLANET_DEG = 95.0, 250.0
TOLERANCE = 6  # of 255: JPEG and interpolation
EDGE = 8  # pixels at the rounded corners of the canvas
WRONG, UNLABELLED = (214, 39, 40), (110, 110, 110)
PANORAMA, BARE_PANORAMA, FLAT_PHOTO = range(3)


def colors_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A colour for every direction, smooth over the whole sphere, no two directions alike."""
    return 127.5 + 100 * directions


def classes_of(directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Classes 1 to 8: octants of the sphere; 0 within 20° of longitude 0, latitude 0."""
    signs = directions > 0
    octants = 1 + signs[..., 0] + 2 * signs[..., 1] + 4 * signs[..., 2]
    ahead = directions[..., 0] > np.cos(np.radians(20))
    classes: NDArray[np.uint8] = np.where(ahead, 0, octants).astype(np.uint8)
    return classes


def panorama_rgb() -> NDArray[np.uint8]:
    return colors_of(equirect_directions((HEIGHT, WIDTH))).round().astype(np.uint8)


def panorama() -> EncodedImage:
    directions = equirect_directions((HEIGHT, WIDTH))
    truth = classes_of(directions)
    prediction = np.maximum(truth, 1)
    prediction[directions[..., 1] < -0.9] = 8
    rgb = panorama_rgb()
    name, note = "a <b>sphere</b>", "mIoU 61.2 %"
    return encode_image(name, rgb, len(NAMES), prediction=prediction, truth=truth, note=note)


def photo() -> EncodedImage:
    v, u = np.meshgrid(*(np.linspace(0, 1, n) for n in PHOTO), indexing="ij")
    rgb = np.stack([40 + 180 * u, 40 + 180 * v, 0 * u + 90], axis=-1).round().astype(np.uint8)
    prediction = (1 + 2 * (v > 0.5) + (u > 0.5)).astype(np.uint8)
    return encode_image("a photo", rgb, len(NAMES), prediction=prediction, sphere=False)


def close(shown: NDArray[Any], expected: NDArray[Any], but: float = 0.0) -> None:
    """All colours equal within the tolerance, but for a share of the pixels."""
    assert shown.shape == expected.shape
    if shown.ndim == 3:
        shown, expected = (image[EDGE:-EDGE, EDGE:-EDGE] for image in (shown, expected))
    far = np.abs(shown - expected).max(axis=-1) > TOLERANCE
    assert far.mean() <= but, f"{far.sum()} of {far.size} pixels, first at {np.argwhere(far)[:3]}"


def view_of(
    report: OpenReport, lon_deg: float, lat_deg: float, width_deg: float, projection: str = "inside"
) -> NDArray[np.float64]:
    """Directions of the pixels of the picture: x at longitude 0, y at longitude 90°, z up.

    Args:
        report: In the browser.
        lon_deg: Longitude of the middle.
        lat_deg: Latitude of the middle.
        width_deg: Angle along the longer side.
        projection: ``inside`` (gnomonic) or ``planet`` (stereographic).
    """
    height, width = report.pixels().shape[:2]
    half = max(height, width) / 2
    x = (np.arange(width) + 0.5 - width / 2) / half
    y = (height / 2 - np.arange(height) - 0.5) / half
    right, up = np.meshgrid(x, y)
    radius, turn = np.hypot(right, up), np.arctan2(up, right)
    edge = np.radians(width_deg) / 2
    angle = (
        np.arctan(radius * np.tan(edge))
        if projection == "inside"
        else 2 * np.arctan(radius * np.tan(edge / 2))
    )
    local = np.stack(
        [np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)], axis=-1
    )
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    tilt = np.array([[np.cos(lat), 0, -np.sin(lat)], [0, 1, 0], [np.sin(lat), 0, np.cos(lat)]])
    spin = np.array([[np.cos(lon), -np.sin(lon), 0], [np.sin(lon), np.cos(lon), 0], [0, 0, 1]])
    directions: NDArray[np.float64] = local @ (spin @ tilt).T
    return directions


def step_rad(report: OpenReport, width_deg: float = START_DEG) -> float:
    """Angle that one pixel of a drag turns: what lies in the middle follows the pointer."""
    return math.tan(math.radians(width_deg) / 2) / (max(report.box()[2:]) / 2)
