"""Legend, readout, keys, mouse and fingers of the viewer in a real Chromium."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.slow.results.browser import OpenReport, opened
from tests.slow.results.reference import (
    classes_of,
    colors_of,
    rays,
)
from tests.slow.results.scene import (
    BARE_PANORAMA,
    COLORS,
    FLAT_PHOTO,
    NAMES,
    START_DEG,
    close,
    step_rad,
    view_of,
)

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Browser


def test_classes_can_be_hidden(report: OpenReport) -> None:
    report.drag(150, 0)
    longitude = -math.degrees(150 * step_rad(report))
    (direction,) = rays((1, 1), longitude, 0, 1, "inside")[0]
    index, photo = int(classes_of(direction)), colors_of(direction)
    dimmed = np.repeat(0.4 * photo @ [0.299, 0.587, 0.114], 3)
    box = report.page.get_by_label(NAMES[index], exact=False)
    report.layer("truth")
    for hide, show in (
        (box.uncheck, box.check),
        *[(report.page.get_by_text(name, exact=True).click for name in ("none", "all"))],
    ):
        close(report.center(), COLORS[index])
        hide()
        report.drawn()
        close(report.center(), dimmed)
        report.layer("overlay")
        close(report.center(), photo)
        report.layer("truth")
        show()
        report.drawn()
    close(report.center(), COLORS[index])


def test_the_legend_names_the_classes_of_the_image_with_their_shares(report: OpenReport) -> None:
    entries = report.page.locator(".legend li").all_inner_texts()
    names = [entry.split("\n")[0].strip() for entry in entries]
    assert names == list(NAMES)
    assert report.text(".shares") == "share of truth / prediction, %"
    truth, prediction = (float(s) for s in entries[3].split("\n")[-1].split("/"))
    assert truth == pytest.approx(12.5, abs=0.15), "an octant"
    assert prediction == pytest.approx(12.5, abs=0.15)
    disc = float(entries[0].split("\n")[-1].split("/")[0])
    assert disc == pytest.approx(50 * (1 - math.cos(math.radians(20))), abs=0.1)


def test_the_class_under_the_pointer_is_named(report: OpenReport) -> None:
    x, y = report.middle()
    box = report.box()
    for dx, dy in ((0.0, 0.0), (190.0, -150.0), (-230.0, 33.0)):
        report.page.mouse.move(x + dx, y + dy)
        report.drawn()
        half = max(box[2:]) / 2
        reach = math.tan(math.radians(START_DEG) / 2) / half
        ray = np.array([1, dx * reach, -dy * reach])
        ray /= np.linalg.norm(ray)
        longitude = math.degrees(math.atan2(ray[1], ray[0]))
        latitude = math.degrees(math.asin(ray[2]))
        text = report.text(".readout").replace("−", "-")
        place, truth, prediction = text.split(" · ")
        words = place.replace("°", "").replace(",", "").split()
        assert float(words[1]) == pytest.approx(longitude, abs=0.06)
        assert float(words[3]) == pytest.approx(latitude, abs=0.06)
        assert truth == f"truth: {NAMES[int(classes_of(ray))]}"
        assert prediction == f"prediction: {NAMES[max(1, int(classes_of(ray)))]}"
    report.page.mouse.move(2, 2)
    report.drawn()
    assert report.text(".readout").startswith("in the middle · truth: unknown")


def test_keys_turn_zoom_reset_and_switch(report: OpenReport) -> None:
    report.press("1")
    half = max(report.box()[2:]) / 2
    turn = math.degrees(half / 8 * step_rad(report))
    report.press("ArrowRight", "ArrowRight")
    close(report.center(), colors_of(rays((1, 1), 2 * turn, 0, 1, "inside"))[0, 0])
    report.press("ArrowLeft", "ArrowLeft", "ArrowUp")
    close(report.center(), colors_of(rays((1, 1), 0, turn, 1, "inside"))[0, 0])
    report.press("ArrowDown", "+")
    close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG / 1.25)))
    report.press("-", "-")
    close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG * 1.25)))
    for reset in ("0", "Home"):
        report.press("ArrowRight", "+", reset)
        close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG)))
    for key, layer in enumerate(("input", "truth", "prediction", "error", "overlay"), start=1):
        report.press(str(key))
        assert report.page.locator(f"input[value={layer}]").is_checked()
    report.press("PageDown")
    assert report.text(".caption") == "bare"
    report.press("PageUp", "PageUp")
    assert report.text(".caption") == "a photo"


def test_missing_layers_are_not_offered(report: OpenReport) -> None:
    def offered() -> list[str]:
        labels = report.page.locator(".layers label")
        return [label.inner_text() for label in labels.all() if label.is_visible()]

    assert offered() == ["Input", "Truth", "Prediction", "Error", "Overlay"]
    report.choose(BARE_PANORAMA)
    assert offered() == ["Input"]
    assert not report.page.locator(".legend").is_visible()
    report.press("2")
    close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG)))
    report.choose(FLAT_PHOTO)
    assert offered() == ["Input", "Prediction", "Overlay"]
    assert report.text(".shares") == "share of prediction, %"


def test_a_phone_can_reach_everything(browser: Browser, page_path: Path) -> None:
    phone: dict[str, Any] = {
        "viewport": {"width": 360, "height": 640},
        "has_touch": True,
        "is_mobile": True,
        "color_scheme": "dark",
    }
    with opened(browser, page_path, **phone) as report:
        page = report.page
        assert page.evaluate("() => document.documentElement.scrollWidth") == 360
        assert page.evaluate("() => innerWidth") == 360, "not zoomed out to fit"
        for control in page.locator(".stage :is(.layers label, select, button, canvas)").all():
            if control.is_visible():
                box = control.bounding_box()
                assert box is not None
                assert box["x"] >= 0
                assert box["x"] + box["width"] <= 360
        background = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
        dark = sum(map(int, background[4:-1].split(","))) < 3 * 128
        assert dark
        for layer in ("truth", "overlay"):
            page.locator(f".layers label:has([value={layer}])").tap()
            assert page.locator(f"input[value={layer}]").is_checked()


def _touch(report: OpenReport, *fingers: list[tuple[float, float]]) -> None:
    """Fingers on the picture, each along its points, then lifted."""
    session = report.page.context.new_cdp_session(report.page)
    kinds = ["touchStart"] + ["touchMove"] * (len(fingers[0]) - 1)
    for kind, *points in zip(kinds, *fingers, strict=True):
        places = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    report.drawn()


def test_fingers_drag_and_pinch(browser: Browser, page_path: Path) -> None:
    phone: dict[str, Any] = {"viewport": {"width": 360, "height": 640}, "has_touch": True}
    with opened(browser, page_path, **phone) as report:
        report.page.locator("canvas").scroll_into_view_if_needed()
        report.layer("input")
        x, y = report.middle()
        _touch(report, [(x, y), (x - 20, y), (x - 50, y + 30)])
        step = math.degrees(step_rad(report))
        # The first move turns at latitude 0; the second sideways too, its 30 pixels upwards last.
        longitude, latitude = 50 * step, 30 * step
        close(report.pixels(), colors_of(view_of(report, longitude, latitude, START_DEG)))
        report.page.get_by_label("Reset the view").tap()
        _touch(report, [(x - 40, y), (x - 60, y)], [(x + 40, y), (x + 60, y)])
        close(report.pixels(), colors_of(view_of(report, 0, 0, START_DEG / 1.5)))
        assert report.page.evaluate("() => visualViewport.scale") == 1, "the page did not zoom"
