"""The page of licenses lists every direct dependency."""

from __future__ import annotations

import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_page_of_licenses_lists_every_direct_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = chain(
        project["dependencies"], chain.from_iterable(project["optional-dependencies"].values())
    )
    names = {found[0] for line in requirements if (found := re.match(r"[\w.-]+", line))}
    page = (ROOT / "docs" / "reference" / "licenses.md").read_text()
    listed = set(re.findall(r"^\| ([\w.-]+) \|", page, re.MULTILINE))
    assert names - listed == {"tangent-train"}, "add these packages to docs/reference/licenses.md"
