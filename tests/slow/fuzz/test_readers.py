"""Broken files of every kind: what comes out is pixels and numbers, or a `DataError`."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from random import Random

import pytest

from tangent_train.errors import DataError
from tangent_train.io import png
from tests.slow.fuzz.mutation import mutate, sealed_png
from tests.slow.fuzz.targets import TARGETS

_LONGEST_MESSAGE = 1000
"""Characters of an error, without the path: the file itself is not shown."""

_HUGE = b"9" * 400


def _try(name: str, path: Path, content: bytes) -> str:
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", module="PIL")  # broken EXIF data, and the like
            warnings.filterwarnings("ignore", "Reading `.npy`")  # as Python 2 wrote them
            TARGETS[name][1](path)
    except DataError as error:
        length = len(str(error).replace(str(path), ""))
        return "refused" if length <= _LONGEST_MESSAGE else f"a message of {length} characters"
    return "read"


@pytest.mark.parametrize("name", TARGETS)
def test_broken_files_are_refused_as_documented(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(png, "MOST_PIXELS", 1 << 22)  # larger ones take long to decode
    seeds = TARGETS[name][0]()
    for seed in seeds:
        assert _try(name, tmp_path / "file.png", seed) == "read"
    rng = Random(0)
    refused = 0
    for number in range(150):
        broken = mutate(seeds[number % len(seeds)], rng)
        broken = sealed_png(broken) if rng.random() < 0.7 else broken
        outcome = _try(name, tmp_path / "file.png", broken)
        assert outcome in ("read", "refused")
        refused += outcome == "refused"
    assert refused > 20


def _changed(name: str, **entries: object) -> bytes:
    return json.dumps(json.loads(TARGETS[name][0]()[0]) | entries).encode()


_FOUND = {
    "label_table": [json.dumps(["x" * 100_000]).encode()],
    "pose": [
        b'{"camera_location":' * 100_000,
        _changed("pose").replace(b"2.25", _HUGE),
        _changed("pose", camera_rt_matrix=[[1e308] * 4] * 3),
        _changed("pose", camera_location="x" * 100_000),
    ],
    "cameras": [
        _changed("cameras", level=10**400),
        _changed("cameras", dim=10**400),
        _changed("cameras", source={"file": "a", "height": 10**400, "width": 1}),
        _changed("cameras", icosahedron_rotation=[[1e308] * 3] * 3),
    ],
    "photo_cameras": [
        b'{"photo": ' + b"[" * 100_000,
        b'{"photo": [[%b, 0, 7], [0, 9, 3], [0, 0, 1]]}' % _HUGE,
        json.dumps({"photo": "x" * 100_000}).encode(),
    ],
    "off": [b"OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 " + b"x" * 100_000],
    "gpano": [TARGETS["gpano"][0]()[0].replace(b'Pixels="180"', b'Pixels="1e9"')],
}


@pytest.mark.parametrize("name", _FOUND)
def test_files_that_were_found(name: str, tmp_path: Path) -> None:
    for content in _FOUND[name]:
        assert _try(name, tmp_path / "file.png", content) == "refused"
