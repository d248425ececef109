"""The documentation site: it is built as `make docs` does, and every page is read."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest

from docs.tools.settings import pages
from tests.slow.documentation.world import ROOT
from tests.slow.results.browser import chromium

LOADED = {
    "audio",
    "embed",
    "iframe",
    "img",
    "input",
    "object",
    "script",
    "source",
    "track",
    "video",
}
"""Elements whose addresses a browser loads; of `link` it loads some."""
CSS_ADDRESS = re.compile(r"""@import\s+["']?([^"');]+)|url\(\s*["']?([^"')]+)""")
MARKDOWN_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^()\s]+)\)")


@dataclass
class PageContent(HTMLParser):
    """The parts of an HTML page that refer to other files.

    Attributes:
        path: File of the page.
        anchors: Names that a link can point to.
        links: Addresses of links.
        loaded: Addresses that a browser loads to show the page.
        paragraphs: Texts of its paragraphs.
        classes: Classes of its elements.
    """

    path: Path
    anchors: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)
    paragraphs: list[str] = field(default_factory=list)
    classes: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()
        self._is_style = self._is_paragraph = False
        self.feed(self.path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.classes |= set(values.get("class", "").split())
        self.loaded += css_addresses(values.get("style", ""))
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag == "link" and not {"canonical", "next", "prev"} & set(values["rel"].split()):
            self.loaded.append(values["href"])
        elif tag in LOADED or tag == "use":
            self.loaded += [values[name] for name in ("src", "data", "href") if name in values]
            self.loaded += [part.split()[0] for part in values.get("srcset", "").split(",") if part]
        self._is_style = tag == "style"
        if tag == "p":
            self._is_paragraph = True
            self.paragraphs.append("")

    def handle_endtag(self, tag: str) -> None:
        self._is_style = False
        self._is_paragraph &= tag != "p"

    def handle_data(self, data: str) -> None:
        if self._is_style:
            self.loaded += css_addresses(data)
        if self._is_paragraph:
            self.paragraphs[-1] += data


def css_addresses(text: str) -> list[str]:
    return ["".join(found) for found in CSS_ADDRESS.findall(text)]


def is_elsewhere(address: str) -> bool:
    return re.match(r"(?!data:)(\w+:)|//", address) is not None


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built without warnings."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    variables = os.environ | {"NO_MKDOCS_2_WARNING": "1", "http_proxy": "http://127.0.0.1:1"}
    variables["https_proxy"] = variables["http_proxy"]
    done = subprocess.run(
        command, check=False, cwd=ROOT, env=variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def contents(site: Path) -> dict[Path, PageContent]:
    return {path: PageContent(path) for path in sorted(site.rglob("*.html"))}


def test_every_page_is_on_the_site(site: Path) -> None:
    for source in (ROOT / "docs").rglob("*.*"):
        page = source.relative_to(ROOT / "docs")
        if page.suffix in (".md", ".ipynb"):
            assert (site / page.with_suffix(".html")).exists()
    assert not (site / "tools").exists()


def test_links_lead_to_pages_and_anchors(site: Path, contents: dict[Path, PageContent]) -> None:
    broken = []
    for page in contents.values():
        for address in page.links + page.loaded:
            target, anchor = urldefrag(address)
            if is_elsewhere(address) or address.startswith("data:"):
                continue
            folder = site if target.startswith("/") else page.path.parent
            path = (folder / unquote(target.lstrip("/"))).resolve() if target else page.path
            path = path / "index.html" if path.is_dir() else path
            is_found = path.exists()
            if anchor and path in contents:
                is_found = unquote(anchor) in contents[path].anchors
            if not is_found:
                broken.append(f"{page.path.relative_to(site)}: {address}")
    assert broken == []


def test_nothing_is_loaded_from_elsewhere(site: Path, contents: dict[Path, PageContent]) -> None:
    elsewhere = [
        f"{page.path.relative_to(site)}: {address}"
        for page in contents.values()
        for address in page.loaded
        if is_elsewhere(address)
    ]
    elsewhere += [
        f"{path.relative_to(site)}: {address}"
        for path in site.rglob("*.css")
        for address in css_addresses(path.read_text("utf-8"))
        if is_elsewhere(address)
    ]
    assert elsewhere == []
    # Scripts of the theme load a library for these.
    for page in contents.values():
        assert not {"mermaid", "arithmatex"} & page.classes


def test_a_browser_loads_nothing_from_elsewhere(
    site: Path, contents: dict[Path, PageContent]
) -> None:
    requests: list[str] = []
    with chromium() as browser:
        page = browser.new_page()
        page.on("request", lambda request: requests.append(request.url))
        for path in contents:
            page.goto(path.as_uri(), wait_until="load")
        page.close()
    assert len(requests) > len(contents)
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []


def test_lists_and_tables_are_not_read_as_text(
    site: Path, contents: dict[Path, PageContent]
) -> None:
    """Python-Markdown needs an empty line before them, CommonMark does not."""
    markup = re.compile(r"^\s*([-*+] |\d+\. |\||#+ |```|> )", re.MULTILINE)
    found = [
        f"{page.path.relative_to(site)}: {text}"
        for page in contents.values()
        for text in page.paragraphs
        if markup.search(text)
    ]
    assert found == []


@pytest.mark.parametrize("path", pages(), ids=lambda path: path.name)
def test_generated_pages_are_up_to_date(path: Path) -> None:
    is_current = path.read_text("utf-8") == pages()[path]
    assert is_current, "run python -m docs.tools.settings"


def local_links(path: Path) -> Iterator[tuple[str, Path, str]]:
    for address in MARKDOWN_LINK.findall(path.read_text("utf-8")):
        target, anchor = urldefrag(address)
        if not is_elsewhere(address):
            yield address, (path.parent / target).resolve() if target else path, anchor


def headings(path: Path) -> set[str]:
    """The anchors that a code host gives to the headings of a page."""
    lines = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


@pytest.mark.parametrize(
    "path",
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")],
    ids=lambda path: path.relative_to(ROOT).as_posix(),
)
def test_links_work_on_a_code_host(path: Path) -> None:
    for address, target, anchor in local_links(path):
        assert target.exists(), address
        if anchor and target.suffix == ".md" and target.name != "python_api.md":
            assert anchor in headings(target), address


@pytest.mark.parametrize("folder", ["tutorials", "how-to", "reference", "explanation", "results"])
def test_the_index_of_a_folder_lists_its_pages(folder: str) -> None:
    index = ROOT / "docs" / folder / "index.md"
    listed = {target for _, target, _ in local_links(index)}
    pages_there = {p for p in index.parent.iterdir() if p.suffix in (".md", ".ipynb")}
    assert pages_there - {index} <= listed
