"""The documentation site, built as `make docs` does: MkDocs itself checks links and anchors."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.tools.settings import pages
from tests.slow.documentation.world import ROOT
from tests.slow.results.browser import chromium

LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\((?!\w+:|#)([^()\s#]+)[^()\s]*\)")
MARKUP = re.compile(r"^\s*([-*+] |\d+\. |\||#+ |```|> )", re.MULTILINE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without warnings and without the internet."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    proxy = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:1")
    variables = os.environ | proxy | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, check=False, cwd=ROOT, env=variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    requests: list[str] = []
    paths = sorted(site.rglob("*.html"))
    with chromium() as browser:
        page = browser.new_page()
        page.on("request", lambda request: requests.append(request.url))
        for path in paths:
            page.goto(path.as_uri(), wait_until="load")
        page.close()
    assert len(requests) > len(paths) > 50
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []


def test_lists_and_tables_are_not_read_as_text(site: Path) -> None:
    """Python-Markdown needs an empty line before them, CommonMark does not."""
    for path in site.rglob("*.html"):
        paragraphs = re.findall(r"<p>(.*?)</p>", path.read_text("utf-8"), re.DOTALL)
        assert [text for text in paragraphs if MARKUP.search(text)] == [], path.name


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.name)
def test_generated_pages_are_up_to_date(path: Path) -> None:
    is_current = path.read_text("utf-8") == pages()[path]
    assert is_current, "run python -m docs.tools.settings"


def test_links_of_the_root_pages_work_on_a_code_host() -> None:
    links = [link for path in ROOT.glob("*.md") for link in LINK.findall(path.read_text("utf-8"))]
    assert len(links) > 20
    assert [link for link in links if not (ROOT / link).exists()] == []
