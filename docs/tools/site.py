"""Build the documentation site: ``python -m docs.tools.site <folder>``.

Zensical reads the Markdown files of one folder. It is given a copy of docs/ with the notebook as
a page, the files from outside docs/, links between them, and typeset formulas. The index of its
search is changed afterwards.
"""

from __future__ import annotations

import json
import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parents[2]
OUTER_FILES = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "tangent_train/results/published.csv": "reference/published.csv",
}
"""Files outside docs/ by their place in the site."""

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:|#)([^()\s#]+)(#[^()\s]*)?\)")
_CODE = re.compile(r"(^ *```.*?^ *```$|`[^`\n]+`)", re.DOTALL | re.MULTILINE)
_FORMULAS = (
    (re.compile(r"(?<=[\w)])\^(?:\(([^()]*)\)|(\w+))"), r"<sup>\1\2</sup>"),
    (re.compile(r"√\(((?:[^()]|\([^()]*\))*)\)"), r"<math><msqrt><mtext>\1</mtext></msqrt></math>"),
    (re.compile(r"\bR_v\("), "R<sub>v</sub>("),
)
"""Powers, roots and the vertex resolution, as they are written in comments and docstrings too."""

_GENERATED = re.compile(r"reference/(settings/|experiments|protocols)|changelog")
_API = "reference/python_api.html#"


def build(site: Path) -> int:
    """Build the site into a new folder; return the exit status, 1 after a warning."""
    with TemporaryDirectory() as folder:
        write_pages(Path(folder) / "docs")
        config = shutil.copy(ROOT / "mkdocs.yml", folder)
        command = [sys.executable, "-m", "zensical", "build", "--config-file", config]
        done = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True)
        sys.stdout.write(re.sub(r"\x1b\[[\d;]*m", "", done.stdout + done.stderr))  # no colors
        if done.returncode == 0:
            shutil.copytree(Path(folder) / "site", site)
            index = site / "search.json"
            index.write_text(demote_generated(index.read_text("utf-8")), "utf-8")
    return done.returncode


def write_pages(folder: Path) -> None:
    """Write the files of the site as Zensical reads them."""
    shutil.copytree(ROOT / "docs", folder, ignore=shutil.ignore_patterns("tools", "*.ipynb"))
    for name, place in OUTER_FILES.items():
        shutil.copy(ROOT / name, folder / place)
    sources = {place: name for name, place in OUTER_FILES.items()}
    for notebook in (ROOT / "docs").rglob("*.ipynb"):
        page = folder / _page_of(notebook.relative_to(ROOT / "docs").as_posix())
        page.write_text(notebook_to_markdown(notebook.read_text("utf-8")), "utf-8")
    for path in folder.rglob("*.md"):
        uri = path.relative_to(folder).as_posix()
        text = set_links(path.read_text("utf-8"), uri, sources.get(uri, f"docs/{uri}"))
        path.write_text(typeset(text), "utf-8")


def set_links(markdown: str, uri: str, source: str) -> str:
    """Point links to the page of a notebook or file; keep the text of links to other files.

    Args:
        markdown: Text of a page.
        uri: Place of the page in the site.
        source: Its file in the repository, to which its links are relative.
    """

    def replace(found: re.Match[str]) -> str:
        image, text, target, anchor = found[1], found[2], found[3], found[4] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in OUTER_FILES:
            place = OUTER_FILES[path]
        elif path.startswith("docs/"):
            place = _page_of(path.removeprefix("docs/"))
        elif (ROOT / path).exists():
            return text
        else:
            return found[0]  # reported by Zensical
        return f"{image}[{text}]({posixpath.relpath(place, posixpath.dirname(uri) or '.')}{anchor})"

    return _LINK.sub(replace, markdown)


def typeset(markdown: str) -> str:
    """Return a text whose formulas outside code are HTML.

    >>> typeset("2^(s+1) rows, √(1 + x²) and `2^(s+1)`")
    '2<sup>s+1</sup> rows, <math><msqrt><mtext>1 + x²</mtext></msqrt></math> and `2^(s+1)`'
    """
    parts = _CODE.split(markdown)
    for index in range(0, len(parts), 2):  # between them is code
        for pattern, replacement in _FORMULAS:
            parts[index] = pattern.sub(replacement, parts[index])
    return "".join(parts)


def notebook_to_markdown(text: str) -> str:
    """Return the cells of a notebook with their outputs as Markdown."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
        parts += map(_output, cell.get("outputs", ()))
    return "\n\n".join(parts)


def demote_generated(index: str) -> str:
    """Return the index of the search so that guides are found before generated pages.

    Zensical has no weights, and prefers short sections. A generated page becomes one section; of
    the Python API, only the first paragraph of each docstring is searched.
    """
    content = json.loads(index)
    sections: dict[str, dict[str, Any]] = {}
    for section in content["items"]:
        place = section["location"]
        if place.startswith(_API):
            section["text"] = section["text"].partition("</p>")[0] + "</p>"
        page = place.partition("#")[0] if _GENERATED.match(place) else place
        if page in sections:
            sections[page]["text"] += f" {section['title']} {section['text']}"
        else:
            sections[page] = section
    return json.dumps(content | {"items": list(sections.values())}, ensure_ascii=False)


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {"text/plain": output.get("text", "")})
    for kind in ("image/png", "image/jpeg"):
        if kind in data:
            return f"![Output of the cell above](data:{kind};base64,{''.join(data[kind].split())})"
    return f"```text\n{''.join(data['text/plain']).rstrip()}\n```"


def _page_of(uri: str) -> str:
    return re.sub(r"\.ipynb$", ".md", uri)


if __name__ == "__main__":
    sys.exit(build(Path(sys.argv[1])))
