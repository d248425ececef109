"""Finished runs, found and read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tangent_train.errors import DataError
from tangent_train.results.record import Heading, find_runs, load_record, unfinished_runs
from tests.results.made_records import BANDS, made_record, write_run

SCORES = (0.1, 0.2, None)


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    record = made_record(SCORES, bands=(0.5, 0.25))
    record = replace(record, intervals={"miou": (0.125, 0.5), "macc_solid_angle": (0.0, 1.0)})
    read = load_record(write_run(tmp_path / "a", record))
    assert read.json() == record.json()
    assert read.settings == record.settings
    assert (read.fold, read.seed, read.data) == (1, 0, "Stanford2D3DS")
    assert read.bands == BANDS
    assert read.score("miou", BANDS[1]) == 0.25
    assert read.score("miou", (0.0, 15.0)) is None
    assert read.score("iou", "floor") == 0.2
    assert read.score("iou", "sofa") is None


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (["headings", "miou", "text"], "a\nb"),
        (["headings", "miou", "unit"], "\x1b[31m"),
        (["headings", "miou", "of_class"], 1),
        (["headings", "miou"], "mIoU"),
        (["headings"], {}),
        (["headings"], {"a b": Heading("")._asdict()}),
        (["headings", "miou", "is_main"], "yes"),
        (["headings", "miou", "better"], True),
    ],
)
def test_headings_are_plain_text(place: list[str], value: Any, tmp_path: Path) -> None:
    path = write_run(tmp_path / "a", made_record(SCORES)) / "results.json"
    part = results = json.loads(path.read_text())
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    path.write_text(json.dumps(results))
    found = r"results\.json: found (headings|is_main|better|no score with a heading)"
    with pytest.raises(DataError, match=found):
        load_record(path.parent)


def test_a_score_cannot_hide_a_field_of_the_file() -> None:
    record = made_record(SCORES)
    with pytest.raises(ValueError, match="cannot have the name images"):
        replace(record, means={"images": 1.0})


def test_runs_are_found_once_and_unfinished_ones_named(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_run(tmp_path / name, made_record(SCORES))
    (tmp_path / "cut" / "checkpoints").mkdir(parents=True)
    found = find_runs([tmp_path / "b", tmp_path])
    assert [path.name for path in found] == ["b", "a"]
    assert unfinished_runs([tmp_path]) == [(tmp_path / "cut").resolve()]
    with pytest.raises(DataError, match=r"cut/results.json: .*tangent-train resume=.*cut"):
        find_runs([tmp_path / "cut"])
    with pytest.raises(DataError, match="no such folder"):
        find_runs([tmp_path / "nowhere"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        ("[]", "list instead of a mapping"),
        ('{"noun": "pairs"}', "no images"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_broken_results_are_named(content: str | None, message: str, tmp_path: Path) -> None:
    path = write_run(tmp_path / "a", made_record(SCORES)) / "results.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=rf"a/results\.json: found .*{message}"):
        load_record(path.parent)


@pytest.mark.parametrize("value", ["0.5", True])
@pytest.mark.parametrize(
    "place",
    [["miou"], ["classes", 0, "iou"], ["latitude_bands", 0, "miou"], ["intervals", "miou"]],
)
def test_scores_must_be_numbers(place: list[Any], value: Any, tmp_path: Path) -> None:
    path = write_run(tmp_path / "a", made_record(SCORES, bands=(0.5,))) / "results.json"
    part = results = json.loads(path.read_text())
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    path.write_text(json.dumps(results))
    with pytest.raises(DataError, match=r"results\.json: found (miou|iou|intervals)="):
        load_record(path.parent)
