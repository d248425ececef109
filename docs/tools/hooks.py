"""Hooks of MkDocs: notebooks, files from outside docs/, links to files outside the site."""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
OUTER_FILES = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "tangent_train/results/published.csv": "reference/published.csv",
}
"""Files outside docs/ by their place in the site."""

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:|#)([^()\s#]+)(#[^()\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files from outside docs/; replace notebooks by pages."""
    for name, page in OUTER_FILES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            files.remove(file)
            text = notebook_to_markdown(file.content_string)
            files.append(File.generated(config, _page_of(file.src_uri), content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links to the page of a notebook or file; keep only the text of other links out."""
    outer_file = next((name for name, uri in OUTER_FILES.items() if uri == page.file.src_uri), None)
    source = outer_file or f"docs/{page.file.src_uri}"

    def replace(found: re.Match[str]) -> str:
        image, text, target, anchor = found[1], found[2], found[3], found[4] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in OUTER_FILES:
            uri = OUTER_FILES[path]
        elif path.startswith("docs/"):
            uri = _page_of(path.removeprefix("docs/"))
        elif (ROOT / path).exists():
            return text
        else:
            return found[0]  # reported by MkDocs
        relative = posixpath.relpath(uri, posixpath.dirname(page.file.src_uri) or ".")
        return f"{image}[{text}]({relative}{anchor})"

    return _LINK.sub(replace, markdown)


def notebook_to_markdown(text: str) -> str:
    """Return the cells of a notebook with their outputs as Markdown."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
        parts += map(_output, cell.get("outputs", ()))
    return "\n\n".join(parts)


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {"text/plain": output.get("text", "")})
    for kind in ("image/png", "image/jpeg"):
        if kind in data:
            return f"![Output of the cell above](data:{kind};base64,{''.join(data[kind].split())})"
    return f"```text\n{''.join(data['text/plain']).rstrip()}\n```"


def _page_of(uri: str) -> str:
    return re.sub(r"\.ipynb$", ".md", uri)
