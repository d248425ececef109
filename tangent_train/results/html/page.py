"""Writing the report as one self-contained HTML file."""

from __future__ import annotations

import html
import json
import re
from base64 import b64encode
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TextIO

from datamodules.images.palette import class_colors
from tangent_train.files import atomic_path
from tangent_train.results.html.images import EncodedImage
from tangent_train.results.tables import Table

__all__ = ["write_report"]

_SCRIPTS = ("view.js", "surfaces.js", "gestures.js", "viewer.js")
_IMAGES = "<!--images-->\n"
_PLACEHOLDER = re.compile(r"\{\{(\w+)\}\}")


def write_report(
    path: Path,
    title: str,
    *,
    tables: Sequence[Table] = (),
    images: Sequence[EncodedImage] = (),
    class_names: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> None:
    """Write a report as one HTML file, atomically.

    Args:
        path: The file.
        title: Of the page.
        tables: Below the viewer.
        images: For the viewer.
        class_names: K + 1 names of the classes in the label maps, the unknown class first.
        notes: Lines below the title, the most important first.
    """
    parts: dict[str, str] = {
        "title": html.escape(title),
        "notes": "\n".join(f"<p>{html.escape(note)}</p>" for note in notes),
        "style": _resource("viewer.css"),
        "viewer": _viewer(class_names) if images else "",
        "script": _script() if images else "",
        "tables": "\n".join(table.html() for table in tables),
    }
    page = _filled(_resource("page.html"), parts)
    before, _, after = page.partition(_IMAGES)
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        file.write(before)
        for image in images:
            _write_image(file, image)
        file.write(after)


def _viewer(class_names: Sequence[str]) -> str:
    colors = class_colors(len(class_names)).tolist()[: len(class_names)]  # perhaps no classes
    classes = [{"name": name, "rgb": rgb} for name, rgb in zip(class_names, colors, strict=True)]
    parts = {"images": _IMAGES, "classes": _json(classes), "shader": _resource("viewer.frag")}
    return _filled(_resource("viewer.html"), parts)


def _script() -> str:
    # A block of its own: no names in the page's global scope.
    body = "\n".join(map(_resource, _SCRIPTS))
    return f'<script>\n"use strict";\n{{\n{body}}}\n</script>'


def _write_image(file: TextIO, image: EncodedImage) -> None:
    note = f'<span class="note">{html.escape(image.note)}</span>' if image.note else ""
    file.write(
        f'<li><button type="button"><img alt="" src="data:image/jpeg;base64,'
        f'{_base64(image.thumbnail)}"><span class="name">{html.escape(image.name)}</span>{note}'
        '</button>\n<script type="application/json">'
    )
    content = image._asdict()
    del content["thumbnail"]
    file.write(f"{_json(content)}</script></li>\n")


def _json(content: Any) -> str:
    """JSON that can neither close the script element around it nor start a comment in it."""
    text = json.dumps(content, separators=(",", ":"), default=_base64)
    return text.replace("<", "\\u003c")


def _base64(content: bytes) -> str:
    return b64encode(content).decode("ascii")


def _filled(template: str, parts: dict[str, str]) -> str:
    """The template with its ``{{names}}`` replaced; inserted text is not scanned again."""
    return _PLACEHOLDER.sub(lambda match: parts[match[1]], template)


def _resource(name: str) -> str:
    return files("tangent_train.results.html").joinpath(name).read_text(encoding="utf-8")
