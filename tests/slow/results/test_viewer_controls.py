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
    NAMES,
    START_DEG,
    close,
    step_rad,
    view_of,
)

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Browser


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
