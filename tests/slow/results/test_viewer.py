"""The viewer in a real Chromium, compared with closed forms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser

from tangent_train.geometry import equirect_directions
from tangent_train.io.palette import class_colors
from tangent_train.results.page import EncodedImage, encode_image, write_report
from tests.rendering.reference import sample_panorama, to_lonlat
from tests.slow.results.browser import EDGE, OpenReport, close, opened

HEIGHT, WIDTH = 251, 503  # odd, no powers of two
PHOTO = (120, 200)
NAMES = ("unknown", *(f"octant {k}" for k in range(1, 8)), "<i>last</i>")
COLORS = class_colors(NAMES).astype(np.int64)
START_DEG, PLANET_DEG = 95.0, 250.0
WRONG, UNLABELED, UNSURE = (214, 39, 40), (136, 136, 136), (94, 60, 153)


def colors_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A color for every direction, smooth over the whole sphere, no two directions alike."""
    return 127.5 + 100 * directions


def classes_of(directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Classes 1 to 8: octants of the sphere; 0 within 20° of longitude 0, latitude 0."""
    signs = directions > 0
    octants = 1 + signs[..., 0] + 2 * signs[..., 1] + 4 * signs[..., 2]
    ahead = directions[..., 0] > np.cos(np.radians(20))
    classes: NDArray[np.uint8] = np.where(ahead, 0, octants).astype(np.uint8)
    return classes


def confidence_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0.2 below to 0.8 above."""
    confidence: NDArray[np.float64] = 0.5 + 0.3 * directions[..., 2]
    return confidence


def panorama() -> EncodedImage:
    directions = equirect_directions((HEIGHT, WIDTH))
    truth = classes_of(directions)
    prediction = np.maximum(truth, 1)
    prediction[directions[..., 1] < -0.9] = 8
    rgb = colors_of(directions).round().astype(np.uint8)
    name, note = "a <b>sphere</b>", "mIoU 61.2 %"
    maps: dict[str, Any] = {
        "prediction": prediction,
        "truth": truth,
        "confidence": confidence_of(directions),
    }
    return encode_image(name, rgb, len(NAMES), note=note, **maps)


def photo() -> EncodedImage:
    v, u = np.meshgrid(*(np.linspace(0, 1, n) for n in PHOTO), indexing="ij")
    rgb = np.stack([40 + 180 * u, 40 + 180 * v, 0 * u + 90], axis=-1).round().astype(np.uint8)
    prediction = (1 + 2 * (v > 0.5) + (u > 0.5)).astype(np.uint8)
    return encode_image("a photo", rgb, len(NAMES), prediction=prediction, sphere=False)


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
    radius, azimuth = np.hypot(right, up), np.arctan2(up, right)
    edge = np.radians(width_deg) / 2
    angle = (
        np.arctan(radius * np.tan(edge))
        if projection == "inside"
        else 2 * np.arctan(radius * np.tan(edge / 2))
    )
    local = np.stack(
        [np.cos(angle), np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth)], axis=-1
    )
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    tilt = np.array([[np.cos(lat), 0, -np.sin(lat)], [0, 1, 0], [np.sin(lat), 0, np.cos(lat)]])
    spin = np.array([[np.cos(lon), -np.sin(lon), 0], [np.sin(lon), np.cos(lon), 0], [0, 0, 1]])
    directions: NDArray[np.float64] = local @ (spin @ tilt).T
    return directions


def step_rad(report: OpenReport) -> float:
    """Angle that one pixel of a drag turns: what lies in the middle follows the pointer."""
    return math.tan(math.radians(START_DEG) / 2) / (max(report.box()[2:]) / 2)


@pytest.fixture(scope="session")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("html") / "a report.html"
    write_report(
        path,
        "Test",
        images=[panorama(), photo()],
        class_names=NAMES,
    )
    return path


@pytest.fixture
def report(browser: Browser, page_path: Path) -> Iterator[OpenReport]:
    with opened(browser, page_path) as open_report:
        yield open_report


def test_the_first_picture_is_the_overlay_ahead(report: OpenReport) -> None:
    assert report.page.locator("input[value=overlay]").is_checked()
    assert report.text(".looking") == "Looking at longitude 0.0°, latitude 0.0° · 95° wide"
    assert report.text(".caption") == "a <b>sphere</b> · mIoU 61.2 %"
    report.layer("input")
    close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG)))


def test_seam_and_poles_are_interpolated_like_the_rest(browser: Browser, tmp_path: Path) -> None:
    """Pixels of 15°: what is wrong with half a pixel at a border shows."""
    gray = np.random.default_rng(0).integers(0, 256, (12, 24, 1), np.uint8)
    image = encode_image("coarse", gray.repeat(3, axis=2), 1)
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


def test_layers_show_the_colors_of_their_classes(report: OpenReport) -> None:
    report.drag(130, 40)  # several octants, errors and the unlabeled disc
    step = math.degrees(step_rad(report))
    longitude, latitude = -130 * step, 40 * step
    view = view_of(report, longitude, latitude, START_DEG)
    truth, photo = classes_of(view), colors_of(view)
    prediction = np.where(view[..., 1] < -0.9, 8, np.maximum(truth, 1))
    assert len(np.unique(truth)) >= 4
    assert np.mean(truth == 0) > 0.02
    assert np.mean((prediction != truth) & (truth > 0)) > 0.02
    gray = (photo @ [0.299, 0.587, 0.114])[..., None]
    error = np.where((truth == prediction)[..., None], 191.25 + 0.25 * gray, WRONG)
    error = np.where((truth == 0)[..., None], UNLABELED, error)
    expected = {
        "truth": COLORS[truth],
        "prediction": COLORS[prediction],
        "error": error,
        "confidence": UNSURE
        + confidence_of(view)[..., None] * (191.25 + 0.25 * gray - np.array(UNSURE)),
        "overlay": 0.6 * photo + 0.4 * COLORS[prediction],
    }
    for layer, colors in expected.items():
        report.layer(layer)
        # Borders lie on pixels of the label map, 0.7° each.
        close(report.pixels(), colors, but=0.03)
    assert not report.page.locator(".errors").is_visible()
    report.layer("error")
    assert report.text(".errors").split() == ["correct", "wrong", "no", "ground", "truth"]


def overlaid(report: OpenReport, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """The overlay without outlines."""
    classes = np.where(view[..., 1] < -0.9, 8, np.maximum(classes_of(view), 1))
    colors: NDArray[np.float64] = 0.6 * colors_of(view) + 0.4 * COLORS[classes]
    return colors


def test_overlaid_classes_have_outlines_of_their_colors(report: OpenReport) -> None:
    report.drag(130, 40)
    step = math.degrees(step_rad(report))
    view = view_of(report, -130 * step, 40 * step, START_DEG)
    shown = report.pixels()
    is_outline = np.abs(shown - overlaid(report, view)).max(axis=-1) > 12
    assert 0.001 < is_outline.mean() < 0.04
    distances = np.abs(shown[is_outline][:, None] - COLORS).max(axis=-1).min(axis=1)
    assert np.mean(distances < 30) > 0.6


def swipe(report: OpenReport, percent: int) -> None:
    report.page.locator(".swipe input").fill(str(percent))
    report.drawn()


@pytest.mark.parametrize("is_flat", [False, True])
def test_a_swipe_shows_the_input_on_the_left(
    browser: Browser, page_path: Path, *, is_flat: bool
) -> None:
    """With WebGL, and without it on the flat image."""
    without = "HTMLCanvasElement.prototype.getContext = new Proxy("
    without += "HTMLCanvasElement.prototype.getContext, {apply: (target, canvas, [kind, ...how]) =>"
    without += " kind === 'webgl2' ? null : Reflect.apply(target, canvas, [kind, ...how])})"
    with opened(browser, page_path, before=without if is_flat else "") as report:
        if not is_flat:
            report.project("flat")
        layers = {}
        for layer in ("input", "prediction"):
            report.layer(layer)
            layers[layer] = report.pixels()
        swipe(report, 25)
        height, width = report.pixels().shape[:2]
        middle = slice(height // 2 - 50, height // 2 + 50)
        column = width // 4
        shown = report.pixels()[middle]
        close(shown[:, : column - 4], layers["input"][middle][:, : column - 4], but=0.01)
        close(shown[:, column + 4 :], layers["prediction"][middle][:, column + 4 :], but=0.01)
        report.layer("input")
        assert not report.page.locator(".swipe").is_visible()
        report.layer("confidence")
        assert report.text(".scale").split("\n") == ["confidence", "0", "50 %", "100 %"]


def test_the_readout_and_the_legend_name_the_ground_truth(report: OpenReport) -> None:
    assert "ground truth: unknown · prediction: octant 1 · confidence: 50 %" in report.text(
        ".readout"
    )
    assert report.text(".shares") == "share of ground truth / prediction, %"
    shares = report.page.locator(".legend .share").all_inner_texts()
    largest = [max(float(k.replace("–", "0")) for k in text.split(" / ")) for text in shares]
    assert largest == sorted(largest, reverse=True)


def test_photos_are_flat_with_pan_and_zoom(report: OpenReport) -> None:
    report.choose(1)
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


def objects_page(folder: Path) -> Path:
    """A panorama with a disc of 20° at longitude 30°, and a photo without objects."""
    directions = equirect_directions((HEIGHT, WIDTH))
    numbers = np.zeros((HEIGHT, WIDTH), np.int32)
    numbers[directions @ [np.cos(np.pi / 6), np.sin(np.pi / 6), 0] > np.cos(np.pi / 9)] = 7
    row = {"number": 7, "class": "<b>lamp</b>", "score": 0.81, "longitude_deg": 30.0}
    rgb, labels = np.full((HEIGHT, WIDTH, 3), 99, np.uint8), np.ones((HEIGHT, WIDTH), np.uint8)
    maps: dict[str, Any] = {"prediction": labels, "numbers": numbers}
    maps["objects"] = {7: row | {"distance_m": None}}
    path = folder / "report.html"
    images = [encode_image("hall", rgb, len(NAMES), **maps), photo()]
    write_report(path, "Objects", images=images, class_names=NAMES)
    return path


@pytest.mark.parametrize("touch", [False, True])
def test_a_click_or_tap_shows_the_row_of_the_object(
    browser: Browser, tmp_path: Path, *, touch: bool
) -> None:
    with opened(browser, objects_page(tmp_path), touch=touch) as report:
        left, top, width, height = report.box()
        shown = "number 7 class <b>lamp</b> score 0.81 longitude_deg 30 distance_m unknown"

        def at(longitude_deg: float) -> tuple[float, float]:
            across = math.tan(math.radians(longitude_deg)) / math.tan(math.radians(START_DEG / 2))
            return left + width / 2 + across * max(width, height) / 2, top + height / 2

        def pointed(longitude_deg: float) -> str:
            press = report.page.touchscreen.tap if touch else report.page.mouse.click
            press(*at(longitude_deg))
            report.drawn()
            return " ".join(report.text(".object").split())

        assert pointed(-30) == ""
        assert pointed(11) == shown
        assert "prediction: <b>lamp</b> 7" in report.text(".readout")
        assert pointed(-30) == ""  # far away: two taps at a place would zoom
        if not touch:
            assert pointed(9) == ""
            report.page.mouse.move(*at(30))
            report.page.mouse.down()
            report.page.mouse.move(*at(20), steps=3)
            report.page.mouse.up()
            assert report.text(".object") == ""  # a drag
        report.press("0", "Enter")
        assert report.text(".object") == ""
        report.press(*["ArrowRight"] * 4, "Enter")
        assert " ".join(report.text(".object").split()) == shown
        report.choose(1)
        assert report.text(".object") == ""
        assert pointed(0) == ""
