"""The documentation site, built as `make docs` does: Zensical checks links to pages and anchors."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import chain
from pathlib import Path
from threading import Thread

import pytest

from docs.tools.settings import pages
from tests.slow.documentation.world import ROOT
from tests.slow.results.browser import DRAWN, chromium

LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\((?!\w+:|#)([^()\s#]+)[^()\s]*\)")
MARKUP = re.compile(r"^\s*([-*+] |\d+\. |\||#+ |```|> )", re.MULTILINE)

WIDTHS = (1440, 390)
CUT_OFF = """() => [...document.querySelectorAll("html, pre, pre code, .md-typeset__scrollwrap")]
  .filter((block) => block.scrollWidth > block.clientWidth + 1)
  .map((block) => block.textContent.slice(0, 80))"""
SEARCHES = {
    "pseudo-label": "how-to/without_labels",
    "batch size": "how-to/troubleshooting",
    "train on my own images": "how-to/own_data",
}
"""Queries and the page of the first result."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without warnings and without the internet."""
    folder = tmp_path_factory.mktemp("documentation") / "site"
    command = [sys.executable, "-m", "docs.tools.site", str(folder)]
    proxy = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:1")
    done = subprocess.run(
        command, check=False, cwd=ROOT, env=os.environ | proxy, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_pages_load_nothing_from_elsewhere_and_are_not_cut_off(site: Path) -> None:
    requests: list[str] = []
    cut_off: list[object] = []
    paths = sorted(site.rglob("*.html"))
    with chromium() as browser:
        page = browser.new_page()
        page.on("request", lambda request: requests.append(request.url))
        for path in paths:
            page.goto(path.as_uri(), wait_until="load")
            for width in WIDTHS:
                page.set_viewport_size({"width": width, "height": 900})
                page.evaluate(DRAWN)
                cut_off += [(path.name, width, text) for text in page.evaluate(CUT_OFF)]
        page.close()
    assert len(requests) > len(paths) > 50
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert cut_off == []


@pytest.mark.parametrize(("query", "page"), SEARCHES.items())
def test_search_finds_guides_first(site: Path, query: str, page: str) -> None:
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, chromium() as browser:
        Thread(target=server.serve_forever, daemon=True).start()
        tab = browser.new_page()
        tab.goto(f"http://127.0.0.1:{server.server_port}/index.html", wait_until="networkidle")
        tab.keyboard.press("Control+k")
        tab.locator("dialog input").fill(query)
        found = tab.locator("a[href*='?h=']").first.get_attribute("href")
        server.shutdown()
    assert found is not None
    assert page in found


def test_lists_and_tables_are_not_read_as_text(site: Path) -> None:
    """Python-Markdown needs an empty line before them, CommonMark does not."""
    for path in site.rglob("*.html"):
        paragraphs = re.findall(r"<p>(.*?)</p>", path.read_text("utf-8"), re.DOTALL)
        assert [text for text in paragraphs if MARKUP.search(text)] == [], path.name


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.name)
def test_generated_pages_are_up_to_date(path: Path) -> None:
    is_current = path.read_text("utf-8") == pages()[path]
    assert is_current, "run python -m docs.tools.settings"


def test_links_lead_to_files_and_pages_are_in_the_menu() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    links = [path.parent / link for path in pages for link in LINK.findall(path.read_text("utf-8"))]
    assert len(links) > 500
    assert [link for link in links if not link.exists()] == []

    menu = re.findall(
        r"^ +- .*?([\w/-]+)\.md", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE
    )
    files = chain((ROOT / "docs").rglob("*.md"), (ROOT / "docs").rglob("*.ipynb"))
    places = [path.relative_to(ROOT / "docs").with_suffix("").as_posix() for path in files]
    assert sorted(menu) == sorted([*places, "contributing", "changelog"])
