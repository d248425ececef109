"""A browser, and a report opened in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tangent_train.results.html import encode_image, write_report
from tangent_train.results.tables import Table
from tests.slow.results.browser import OpenReport, chromium, opened
from tests.slow.results.scene import NAMES, panorama, panorama_rgb, photo


# Not for the whole session: while it runs, no other test could start an event loop.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


@pytest.fixture(scope="session")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("html") / "a report.html"
    write_report(
        path,
        "Test",
        tables=[Table("Wide", [f"column {k}" for k in range(30)], [["12345.6"] * 30])],
        images=[panorama(), encode_image("bare", panorama_rgb(), len(NAMES)), photo()],
        class_names=NAMES,
        notes=["a note without any place to break: " + "x" * 200],
    )
    return path


@pytest.fixture
def report(browser: Browser, page_path: Path) -> Iterator[OpenReport]:
    with opened(browser, page_path) as open_report:
        yield open_report
