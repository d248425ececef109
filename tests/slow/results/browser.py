"""A real browser at a report."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, ConsoleMessage, FloatRect, Page, sync_playwright

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL on the processor; no sandbox, as containers often run as root.
ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
TOLERANCE = 6  # of 255: JPEG and interpolation
EDGE = 8  # pixels at the rounded corners of the canvas
# Two frames: what an event asked for has been drawn. Playwright waits for promises without end.
DRAWN = """() => new Promise((done, failed) => {
  setTimeout(() => failed(new Error("no frame was drawn in 20 s")), 20_000);
  requestAnimationFrame(() => requestAnimationFrame(done));
})"""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Open the Chromium of the system, or skip the test without one."""
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(PROGRAMS)} is on the path")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        yield browser
        browser.close()


def close(shown: NDArray[Any], expected: NDArray[Any], but: float = 0.0) -> None:
    """All colors equal within the tolerance, but for a share of the pixels."""
    assert shown.shape == expected.shape
    if shown.ndim == 3:
        shown, expected = (image[EDGE:-EDGE, EDGE:-EDGE] for image in (shown, expected))
    far = np.abs(shown - expected).max(axis=-1) > TOLERANCE
    assert far.mean() <= but, f"{far.sum()} of {far.size} pixels, first at {np.argwhere(far)[:3]}"


@dataclass
class OpenReport:
    """A report in the browser.

    Attributes:
        page: Page of the browser.
        problems: Errors, warnings and requests since it was opened.
    """

    page: Page
    problems: list[str] = field(default_factory=list)

    def text(self, selector: str) -> str:
        """Visible text of an element."""
        return self.page.locator(selector).inner_text().strip()

    def drawn(self) -> None:
        """Wait until all images are decoded and drawn."""
        self.page.wait_for_selector("#viewer:not(.busy) .caption:not(:empty)", timeout=20_000)
        self.page.evaluate(DRAWN)

    def choose(self, number: int) -> None:
        """Click an image of the strip."""
        self.page.locator(".gallery button").nth(number).click()
        self.page.wait_for_selector(f".gallery li:nth-child({number + 1}) [aria-current=true]")
        self.drawn()

    def layer(self, name: str) -> None:
        """Choose a layer."""
        self.page.locator(f"input[name=layer][value={name}]").check()
        self.drawn()

    def project(self, name: str) -> None:
        """Choose a projection."""
        self.page.locator(".projection").select_option(name)
        self.drawn()

    def press(self, *keys: str) -> None:
        """Press keys with the picture in focus."""
        self.page.locator("canvas").focus()
        for key in keys:
            self.page.keyboard.press(key)
        self.drawn()

    def box(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the picture."""
        box = self.page.locator("canvas").bounding_box()
        assert box is not None
        return box["x"], box["y"], box["width"], box["height"]

    def drag(self, dx: float, dy: float) -> None:
        """Drag the picture with the mouse, from its middle."""
        left, top, width, height = self.box()
        x, y = left + width / 2, top + height / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + dx, y + dy)
        self.page.mouse.up()
        self.drawn()

    def pixels(self) -> NDArray[np.int64]:
        """Pixels of the canvas, ``(height, width, 3)``, without the buttons above it."""
        self.page.locator("canvas").scroll_into_view_if_needed()
        for shown in ("hidden", ""):
            if shown == "":
                png = self.page.screenshot(clip=self._clip())
            above = self.page.locator(".buttons, .errors, .scale")
            above.evaluate_all("(all, v) => all.forEach((e) => (e.style.visibility = v))", shown)
        pixels: Any = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        return pixels[..., ::-1].astype(np.int64)

    def _clip(self) -> FloatRect:
        """The canvas in whole pixels of the window."""
        x, y, width, height = self.box()
        return {"x": round(x), "y": round(y), "width": int(width), "height": int(height)}


@contextmanager
def opened(
    browser: Browser, path: Path, *, before: str = "", touch: bool = False
) -> Iterator[OpenReport]:
    """Open a report in a window; afterwards there must be no errors and no requests.

    Args:
        browser: Browser.
        path: The report.
        before: Script that runs before those of the page.
        touch: True for a window with a touch screen.
    """
    window = browser.new_context(viewport={"width": 600, "height": 800}, has_touch=touch)
    window.set_default_timeout(20_000)
    window.add_init_script(before)
    report = OpenReport(window.new_page())

    def record(message: ConsoleMessage) -> None:
        if "GL Driver Message" not in message.text:  # a slow machine, not the page
            report.problems.append(f"{message.type}: {message.text}")

    report.page.on("console", record)
    report.page.on("pageerror", lambda error: report.problems.append(str(error)))
    report.page.on("request", lambda request: report.problems.append(request.url[:200]))
    report.page.goto(path.as_uri())
    report.drawn()
    yield report
    window.close()
    fetched = [url for url in report.problems if not url.startswith("data:image/")]
    assert fetched == [path.as_uri()], fetched
