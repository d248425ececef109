"""Broken files of every kind: the errors are those that are documented."""

from __future__ import annotations

import json
import struct
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datamodules.images.gpano import NAMESPACE
from datamodules.images.image_opening import MOST_PIXELS
from datamodules.images.pixel_files import read_pixels
from datamodules.images.png import read_color_png
from tangent_train.errors import DataError
from tests.slow.fuzz.mutation import png_chunk
from tests.slow.fuzz.targets import LARGEST_IMAGE, LONGEST_MESSAGE, TARGETS, Target

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from random import Random


@pytest.fixture(autouse=True)
def _small_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MOST_PIXELS, str(LARGEST_IMAGE))


@pytest.mark.parametrize("name", TARGETS)
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    for seed in TARGETS[name].seeds():
        assert TARGETS[name].try_on(tmp_path / "file.png", seed) == "read"
    if TARGETS[name].inner:
        part, put = _part(name)
        assert TARGETS[name].try_on(tmp_path / "file.png", put(part)) == "read"


@pytest.mark.parametrize("name", [name for name in TARGETS if TARGETS[name].inner])
def test_parts_are_put_back_where_they_were(name: str) -> None:
    part, put = _part(name)
    again, _ = _inner(name, put(part))
    assert again == part
    other, _ = _inner(name, put(part[:-1]))
    assert other == part[:-1]


@pytest.mark.parametrize("name", TARGETS)
@settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(rng=st.randoms(use_true_random=False), number=st.integers(0, 1000))
def test_broken_files_are_refused_as_documented(
    name: str, tmp_path: Path, rng: Random, number: int
) -> None:
    seeds = TARGETS[name].seeds()
    broken = TARGETS[name].broken(seeds[number % len(seeds)], rng, seeds)
    TARGETS[name].try_on(tmp_path / "file.png", broken)


# --- what the fuzzer found, or should have ------------------------------------------------------

_DEEP = b"[" * 100_000
_HUGE = b"9" * 400


def _pose(**entries: Any) -> bytes:
    return json.dumps(json.loads(TARGETS["pose"].seeds()[0]) | entries).encode()


def _cameras(**entries: Any) -> bytes:
    return json.dumps(json.loads(TARGETS["cameras"].seeds()[0]) | entries).encode()


def _store(change: Callable[[dict[str, Any]], object]) -> bytes:
    """A store file whose header was changed, with the right checksum."""
    header, put = _part("store")
    content = json.loads(header)
    change(content)
    return put(json.dumps(content).encode())


def _part(name: str) -> tuple[bytes, Callable[[bytes], bytes]]:
    return _inner(name, TARGETS[name].seeds()[0])


def _inner(name: str, content: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    inner = TARGETS[name].inner
    assert inner is not None
    found = inner(content)
    assert found is not None
    return found


def _xmp(tags: bytes) -> bytes:
    text, put = _part("xmp")
    return put(text.replace(b'GPano:FullPanoHeightPixels="180"', tags))


def _npz() -> bytes:
    file = BytesIO()
    np.savez(file, steps=np.zeros((8, 16, 6), np.uint16))
    return file.getvalue()


def _png(width: int, height: int, bits: int, color: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", b"x\x9c\x03\0\0\0\0\1")
    return b"\x89PNG\r\n\x1a\n" + chunks + png_chunk(b"IEND", b"")


_FOUND = {
    "label_table-deep": _DEEP,
    "label_table-long-name": json.dumps(["x" * 100_000]).encode(),
    "classes-deep": _DEEP,
    "classes-many": json.dumps([f"{i}" for i in range(200_000)]).encode(),
    "classes-long": json.dumps("x" * 100_000).encode(),
    "pose-deep": b'{"camera_location":' * 100_000,
    "pose-huge-number": _pose().replace(b"2.25", _HUGE),
    "pose-huge-rotation": _pose(camera_rt_matrix=[[1e308] * 4] * 3),
    "pose-long": _pose(camera_location="x" * 100_000),
    "pose-camera-huge-number": b'{"camera_k_matrix": [[%b, 0, 1], [0, 1, 1], [0, 0, 1]]}' % _HUGE,
    "pose-camera-deep": b'{"camera_k_matrix":' * 100_000,
    "cameras-deep": _DEEP,
    "cameras-huge-level": _cameras(level=10**400),
    "cameras-huge-dim": _cameras(dim=10**400),
    "cameras-huge-panorama": _cameras(source={"file": "a", "height": 10**400, "width": 1}),
    "cameras-huge-rotation": _cameras(icosahedron_rotation=[[1e308] * 3] * 3),
    "cameras-huge-matrix": _cameras(camera={"matrix": [[10**400] * 3] * 3}),
    "off-long": b"OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 " + b"x" * 100_000,
    "store-no-json": _part("store")[1](b"{"),
    "store-no-text": _part("store")[1](b"\xff\xfe\xff"),
    "store-deep": _part("store")[1](_DEEP),
    "store-other-json": _part("store")[1](b"3"),
    "store-no-arrays": _store(lambda header: header.pop("arrays")),
    "store-no-labels": _store(lambda header: header["arrays"].pop("labels")),
    "store-addresses": _store(lambda header: header["arrays"]["labels"].update(dtype="|O")),
    "store-other-sizes": _store(lambda header: header["arrays"]["labels"].update(shape=[4, 32])),
    "store-past-the-end": _store(lambda header: header["arrays"]["labels"].update(offset=1 << 40)),
    "store-huge-shape": _store(lambda header: header["arrays"]["rgb"].update(shape=[1 << 62] * 3)),
    "store-other-array": _store(lambda header: header["arrays"].update(x=header["arrays"]["rgb"])),
    "store-few-counts": _store(lambda header: header.update(label_counts=[1, 2])),
    "store-huge-count": _store(lambda header: header.update(label_counts=[1 << 70] * 256)),
    "store-made-of-nothing": _store(lambda header: header.update(made_from=[])),
    "store-no-checksum": _store(lambda header: header.update(crc32=None)),
    "spheres-broken-header": _part("spheres")[1](b"{'descr': '<u2', 'fortran_order': (\n"),
    "spheres-huge": _part("spheres")[1](
        b"{'descr': '<u2', 'fortran_order': False, 'shape': (1099511627776, 16, 6)}\n"
    ),
    "spheres-archive": _npz(),
    "spheres-list-deep": b'{"a":' * 100_000,
    "pixels-broken-header": _part("spheres")[1](b"{'descr': '<u2', 'fortran_order': (\n"),
    "pixels-huge-array": _part("spheres")[1](
        b"{'descr': '<u2', 'fortran_order': False, 'shape': (4294967296, 4294967296, 4)}\n"
    ),
    "pixels-archive": _npz(),
    "pixels-huge": _png(60_000, 60_000, 16, 0),
    "label_image-huge": _png(60_000, 60_000, 8, 2),
    "label_image-huge-depth": _png(60_000, 60_000, 16, 0),
    "xmp-huge-sphere": _xmp(b'GPano:FullPanoHeightPixels="1.7e308"'),
    "xmp-long": _xmp(b'GPano:FullPanoHeightPixels="%b"' % (b"x" * 100_000)),
}


@pytest.mark.parametrize("case", _FOUND)
def test_files_that_were_found(case: str, tmp_path: Path) -> None:
    target = TARGETS[case.partition("-")[0]]
    assert target.try_on(tmp_path / "file.png", _FOUND[case]) == "refused"


def test_long_text_of_xmp_takes_no_long_time(tmp_path: Path) -> None:
    # Expat hands over every entity by itself; adding each to the text so far would take minutes.
    text, put = _part("xmp")
    told = (
        b'<GPano:Notes xmlns:GPano="%b">' % NAMESPACE.encode()
        + b"&amp;" * 2_000_000
        + b"</GPano:Notes>"
    )
    TARGETS["xmp"].try_on(tmp_path / "file.png", put(text.replace(b"</r:RDF>", told + b"</r:RDF>")))


@pytest.mark.parametrize("read", [read_color_png, partial(read_pixels, indices=True)])
def test_chunks_that_promise_much_are_not_decoded(
    read: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object) -> None:
        pytest.fail("OpenCV takes 3 GB for these few bytes")

    monkeypatch.setattr(cv2, "imdecode", decode)
    path = tmp_path / "file.png"
    whole = _png(16, 8, 16, 0)
    path.write_bytes(whole[:33] + struct.pack(">I", 3_000_000_000) + whole[37:])
    with pytest.raises(DataError, match=f"{path}: found"):
        read(path)


# --- the fuzzer itself --------------------------------------------------------------------------


def test_other_errors_and_long_ones_come_out(tmp_path: Path) -> None:
    def other(path: Path) -> None:
        raise KeyError(path)

    def long(path: Path) -> None:
        raise DataError(path, found="x", expected="y" * LONGEST_MESSAGE)

    with pytest.raises(KeyError):
        Target(list, other).try_on(tmp_path / "file", b"")
    with pytest.raises(AssertionError, match="a message of"):
        Target(list, long).try_on(tmp_path / "file", b"")
