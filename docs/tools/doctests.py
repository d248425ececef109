"""Extension of Griffe: doctests in docstrings are shown as code, formulas are typeset."""

from __future__ import annotations

import re
from typing import Any

import griffe

from docs.tools.site import typeset

_DOCTEST = re.compile(r"^( *)(>>> .*(?:\n *\S.*)*)", re.MULTILINE)


class Doctests(griffe.Extension):
    """Put doctests in code blocks; typeset formulas."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of an object; called by Griffe."""
        if obj.docstring is not None:
            text = _DOCTEST.sub(
                lambda found: f"{found[1]}```pycon\n{found[0]}\n{found[1]}```", obj.docstring.value
            )
            obj.docstring.value = typeset(text)
