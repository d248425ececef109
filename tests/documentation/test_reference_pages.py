"""Reference pages are complete: they name every data set, field and dependency."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import fields
from itertools import chain
from pathlib import Path

from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.geometry import TangentGrid
from tangent_train.inference.api import __file__ as label_maps
from tangent_train.io.camera_files import CameraFile, write_cameras
from tangent_train.metrics.scores import ScoreColumn
from tangent_train.results.evaluation import EvaluationResult

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"


def missing(names: set[str], page: str) -> set[str]:
    """Names that a reference page does not show as code.

    Args:
        names: Names of fields or options.
        page: File name of the page.
    """
    shown = chain.from_iterable(
        re.findall(r"[\w./-]+", code)
        for code in re.findall(r"`([^`\n]+)`", (REFERENCE / page).read_text())
    )
    return names - set(shown)


def test_licenses_lists_every_direct_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = chain(
        project["dependencies"], chain.from_iterable(project["optional-dependencies"].values())
    )
    names = {found[0] for line in requirements if (found := re.match(r"[\w.-]+", line))}
    page = (REFERENCE / "licenses.md").read_text()
    listed = set(re.findall(r"^\| ([\w.-]+) \|", page, re.MULTILINE))
    assert names - listed == {"tangent-train"}, "add these packages to docs/reference/licenses.md"


def test_data_sets_names_every_option() -> None:
    options = {path.stem for path in (ROOT / "configs" / "data").glob("*.yaml")}
    assert not missing(options, "data_sets.md")


def test_file_formats_names_every_field_of_results() -> None:
    record = EvaluationResult("panoramas", 1, {"miou": ScoreColumn("mIoU")}, {"miou": 0.5})
    assert not missing(set(json.loads(record.json())), "file_formats.md")


def test_file_formats_names_every_field_of_an_exported_network() -> None:
    names = {field.name for field in fields(LoadedNetwork)} - {"module", "trust"}
    assert not missing(names, "file_formats.md")


def test_file_formats_names_every_field_of_cameras(tmp_path: Path) -> None:
    grid = TangentGrid(base_level=0, level=3)
    cameras = CameraFile("room.jpg", (16, 32), grid, (0,), ("face_000.png",))
    write_cameras(tmp_path / "cameras.json", cameras)
    content = json.loads((tmp_path / "cameras.json").read_text())
    names = {*content, *content["camera"], *content["images"][0]}
    assert not missing(names, "file_formats.md")


def test_file_formats_names_every_label_map() -> None:
    maps = {path.stem for path in Path(label_maps).with_name("label_maps").glob("*.json")}
    assert not missing(maps, "file_formats.md")
