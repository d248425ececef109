"""The viewer in a real Chromium, compared with closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Browser

from tangent_train.geometry import equirect_directions
from tangent_train.results.html import encode_image, write_report
from tests.rendering.reference import sample_panorama, to_lonlat
from tests.slow.results.browser import OpenReport, opened
from tests.slow.results.scene import (
    COLORS,
    EDGE,
    FLAT_PHOTO,
    HEIGHT,
    NAMES,
    PHOTO,
    PLANET_DEG,
    START_DEG,
    UNLABELLED,
    WIDTH,
    WRONG,
    classes_of,
    close,
    colors_of,
    step_rad,
    view_of,
)


def test_the_first_picture_is_the_overlay_ahead(report: OpenReport) -> None:
    assert report.page.locator("input[value=overlay]").is_checked()
    assert report.text(".looking") == "Looking at longitude 0.0°, latitude 0.0° · 95° wide"
    assert report.text(".caption") == "a <b>sphere</b> · mIoU 61.2 %"
    report.layer("input")
    close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG)))


def test_seam_and_poles_are_interpolated_like_the_rest(browser: Browser, tmp_path: Path) -> None:
    """Pixels of 15°: what is wrong with half a pixel at a border shows."""
    grey = np.random.default_rng(0).integers(0, 256, (12, 24, 1), np.uint8)
    image = encode_image("coarse", grey.repeat(3, axis=2), 1)
    pixels: Any = cv2.imdecode(np.frombuffer(image.input, np.uint8), cv2.IMREAD_COLOR)
    write_report(tmp_path / "report.html", "t", images=[image], class_names=NAMES[:1])
    with opened(browser, tmp_path / "report.html") as report:

        def check(longitude: float, latitude: float) -> None:
            lonlat = to_lonlat(view_of(report, longitude, latitude, START_DEG))
            close(report.pixels(), sample_panorama(pixels.astype(np.float64), lonlat, "bilinear"))

        report.drag(math.pi / step_rad(report), 0)
        check(180, 0)
        report.press("0")
        report.drag(0, 4000)
        check(0, 90)
        report.drag(0, -8000)
        check(0, -90)


def test_the_little_planet_and_the_flat_map(report: OpenReport) -> None:
    report.layer("input")
    report.project("planet")
    view = view_of(report, 0, -90, PLANET_DEG, projection="planet")
    close(report.pixels(), colors_of(view))
    report.project("flat")
    pixels = report.pixels()
    height, width = pixels.shape[:2]
    rows = int(width * HEIGHT / WIDTH)
    top = (height - rows) // 2
    assert top > EDGE
    assert pixels[EDGE : top - 1, EDGE:-EDGE].max() < 40, "nothing beyond the poles"
    fitted = pixels[top + 2 : top + rows - 2]
    expected = colors_of(equirect_directions((rows, width)))[2 : 2 + len(fitted)]
    close(fitted, expected)


def test_layers_show_the_colours_of_their_classes(report: OpenReport) -> None:
    report.drag(130, 40)  # several octants, errors and the unlabelled disc
    step = math.degrees(step_rad(report))
    longitude, latitude = -130 * step, 40 * step
    view = view_of(report, longitude, latitude, START_DEG)
    truth, photo = classes_of(view), colors_of(view)
    prediction = np.where(view[..., 1] < -0.9, 8, np.maximum(truth, 1))
    assert len(np.unique(truth)) >= 4
    assert np.mean(truth == 0) > 0.02
    assert np.mean((prediction != truth) & (truth > 0)) > 0.02
    grey = (photo @ [0.299, 0.587, 0.114])[..., None]
    error = np.where((truth == prediction)[..., None], 191.25 + 0.25 * grey, WRONG)
    error = np.where((truth == 0)[..., None], UNLABELLED, error)
    expected = {
        "truth": COLORS[truth],
        "prediction": COLORS[prediction],
        "error": error,
        "overlay": 0.45 * photo + 0.55 * COLORS[prediction],
    }
    for layer, colors in expected.items():
        report.layer(layer)
        # Borders lie on pixels of the label map, 0.7° each.
        close(report.pixels(), colors, but=0.03)
    assert not report.page.locator(".errors").is_visible()
    report.layer("error")
    assert report.text(".errors").split() == ["right", "wrong", "unlabelled"]


def test_photos_are_flat_with_pan_and_zoom(report: OpenReport) -> None:
    report.choose(FLAT_PHOTO)
    report.layer("input")
    assert not report.page.locator(".projection").is_visible()
    x, y, width, height = report.box()
    scale = min(width / PHOTO[1], height / PHOTO[0])

    def color(u: float, v: float) -> NDArray[np.float64]:
        return np.array([40 + 180 * u, 40 + 180 * v, 90])

    pixels = report.pixels()
    assert pixels[20, 20].max() < 40, "nothing beside it"
    # A point a quarter to the right and down stays there while the wheel turns.
    dx, dy = PHOTO[1] * scale / 4, PHOTO[0] * scale / 4
    row, column = int(height / 2 + dy), int(width / 2 + dx)
    close(pixels[row, column], color(0.75, 0.75))
    report.page.mouse.move(x + width / 2 + dx, y + height / 2 + dy)
    report.page.mouse.wheel(0, -240)
    report.drawn()
    zoomed = report.pixels()
    close(zoomed[row, column], color(0.75, 0.75))
    factor = math.exp(0.48)
    close(zoomed[row, int(column - dx)], color(0.75 - 0.25 / factor, 0.75))
    assert report.text(".readout").startswith("column 1")
    report.drag(4000, 4000)  # to the upper left corner, no further
    shown = factor * scale
    corner = report.pixels()[20, 20]
    close(corner, color(20.5 / PHOTO[1] / shown, 20.5 / PHOTO[0] / shown))
