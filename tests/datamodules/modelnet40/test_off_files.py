from __future__ import annotations

import os
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from datamodules.modelnet40.mesh_spheres import clean_mesh, mesh_spheres
from datamodules.modelnet40.off_files import Mesh, read_off, write_off
from tangent_train.errors import DataError

REAL_DATA = os.environ.get("TANGENT_REAL_DATA")
POINTS = "0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n"
SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]


def _read(folder: Path, content: str | bytes) -> Mesh:
    path = folder / "mesh.off"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_off(path)


# --- what is read ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n",
        f"OFF4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n",  # glued, as in ModelNet40
        f"OFF 4 2\n{POINTS}3 0 1 2\n3 0 2 3",  # one line, no edges, no newline at the end
        f"\n \t OFF # a mesh\n# more\n\n4 2 5\t#\n{POINTS}\n3 0 1 2#\n\n   3\t0  2 3  \n\n",
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n".replace("\n", "\r\n"),
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n".replace("\n", "\r"),
        f"OFF\n4 1 0\n{POINTS}4 0 1 2 3\n",
        f"OFF\n4 2 0\n{POINTS}3 0 1 2 255 0 0\n3 0 2 3 0.1 0.2 0.3 1\n",
        f"COFF\n4 1 0\n{POINTS}4 0 1 2 3\n".replace("0\n1", "0 255 0 0 255\n1"),
        "NOFF\n4 1 0\n0 0 0 0 0 1\n1 0 0 0 0 1\n1 1 0 0 0 1\n0 1 0.5 0 0 1\n4 0 1 2 3\n",
        f"OFF\n4 3 0\n{POINTS}2 0 1\n3 0 1 2\n3 0 2 3\n",  # an edge is no face
        f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3\n".replace("0.5", "+5E-1"),
        b"\xef\xbb\xbfOFF # \xff\xfe\n4 1 0\n" + POINTS.encode() + b"4 0 1 2 3\n",
    ],
)
def test_all_ways_to_write_a_mesh(tmp_path: Path, content: str | bytes) -> None:
    vertices, triangles = _read(tmp_path, content)
    assert vertices.tolist() == SQUARE
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert vertices.dtype == np.float64
    assert triangles.dtype == np.int64


def test_polygons_in_the_order_of_the_file(tmp_path: Path) -> None:
    points = "".join(f"{k} {k * k} 0\n" for k in range(6))
    faces = "3 5 4 3\n6 0 1 2 3 4 5\n4 2 3 4 5\n3 0 1 2\n1 3\n0\n5 1 2 3 4 5\n"
    mesh = _read(tmp_path, f"OFF\n6 7 0\n{points}{faces}")
    expected = [[5, 4, 3]]
    expected += [[0, k, k + 1] for k in range(1, 5)]
    expected += [[2, 3, 4], [2, 4, 5], [0, 1, 2]]
    expected += [[1, k, k + 1] for k in range(2, 5)]
    assert mesh.triangles.tolist() == expected


def test_what_is_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mesh = Mesh(rng.normal(size=(50, 3)) * 100, rng.integers(0, 50, (90, 3)))
    path = tmp_path / "folder" / "mesh.off"
    write_off(path, mesh)
    again = read_off(path)
    np.testing.assert_allclose(again.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(again.triangles, mesh.triangles)
    other = trimesh.load(str(path), process=False, force="mesh")
    np.testing.assert_array_equal(other.vertices, again.vertices)
    np.testing.assert_array_equal(other.faces, again.triangles)


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "line", "found"),
    [
        ("OFF\n4 1 0\n0 0 0\n1 0 zero\n1 1 0\n0 1 0\n3 0 1 2\n", 4, "'zero'"),
        ("OFF\n# two\n4 1 0\n0 0 0\n\n1 0\n1 1 0\n0 1 0\n3 0 1 2\n", 6, "'1 0'"),
        ("OFF\n3 1 0\n0 0 0\n1 nan 0\n1 1 0\n3 0 1 2\n", 4, "'nan'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 -1e999\n3 0 1 2\n", 5, "'-1e999'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 1_0\n3 0 1 2\n", 5, "'1_0'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 3\n", 6, "vertex '3'"),
        ("OFF\n3 2 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n3 0 -1 2\n", 7, "vertex '-1'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1.5 2\n", 6, "vertex '1.5'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1\n", 6, "2 vertices"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n999999999999 0 1\n", 6, "2 vertices"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n-3 0 1 2\n", 6, "'-3'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\nthree 0 1 2\n", 6, "'three'"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 99999999999999999999\n", 6, "vertex '9999"),
        ("OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n", 2, "4 vertices and 1 faces"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n3 0 1 2\n", 2, "3 vertices and 1 faces"),
        ("OFF\n0 0 0\n", 2, "0 vertices and 0 faces"),
        ("OFF\n1 0 0\n0 0 0\n", 2, "1 vertices and 0 faces"),
        ("OFF\n-3 1 0\n0 0 0\n", 2, "'-3 1 0'"),
        ("OFF\n3\n1\n0 0 0\n", 2, "'3'"),
        ("OFF\n3 1.5 0\n", 2, "'3 1.5 0'"),
        ("OFF\n", 1, "nothing more"),
        ("OFFICE\n3 1 0\n", 1, "'ICE'"),
        ("off\n3 1 0\n", 1, "'off'"),
        ("3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n", 1, "'3 1 0'"),
        ("4OFF\n3 1 0\n", 1, "'4OFF'"),
        ("nOFF\n3 1 0\n", 1, "'nOFF'"),
        ("OFF BINARY\n3 1 0\n", 1, "binary OFF"),
        ("solid cube\nfacet\n", 1, "'solid cube'"),
        (b"OFF\n3 1 0\n\0\0\0\0", 1, "binary content"),
        (b"\x89PNG\r\n\x1a\n\0\0", 1, "binary content"),
        ("v" * 10_000, 1, "'vvvv"),
    ],
)
def test_the_error_names_file_and_line(
    tmp_path: Path, content: str | bytes, line: int, found: str
) -> None:
    with pytest.raises(DataError) as caught:
        _read(tmp_path, content)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'mesh.off'}, line {line}: found {found}")
    assert "expected" in message
    assert len(message) < 400


@pytest.mark.parametrize("content", ["", "\n \n", "# only\n#comments\n"])
def test_empty_files(tmp_path: Path, content: str) -> None:
    with pytest.raises(DataError, match="found an empty file"):
        _read(tmp_path, content)


def test_no_face_that_is_one(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no face of three corners"):
        _read(tmp_path, f"OFF\n4 2 0\n{POINTS}2 0 1\n0\n")


def test_files_that_are_none(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing.off"):
        with pytest.raises(DataError, match=f"{re.escape(str(path))}: found nothing to read"):
            read_off(path)


def test_truncated_anywhere(tmp_path: Path) -> None:
    whole = f"OFF\n4 2 0\n{POINTS}3 0 1 2\n3 0 2 3".encode()
    assert len(_read(tmp_path, whole).triangles) == 2
    for size in range(len(whole)):
        with pytest.raises(DataError):
            _read(tmp_path, whole[:size])


@pytest.mark.parametrize(
    "content",
    [
        "OFF\n999999999999999 999999999999999 0\n0 0 0\n",
        "OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n999999999999999 0 1 2\n",
    ],
)
def test_absurd_numbers_take_no_memory(tmp_path: Path, content: str) -> None:
    tracemalloc.start()
    with pytest.raises(DataError):
        _read(tmp_path, content)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


TOKENS = st.sampled_from(
    ["OFF", "COFF", "3", "4", "0", "1", "2", "-1", "1.5", "nan", "1e400", "#", "x", "²", "", "_1"]
)
LINES = st.lists(st.lists(TOKENS, max_size=6).map(" ".join), max_size=14).map("\n".join)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=300), LINES.map(lambda text: f"OFF 3 1\n{text}".encode())))
@example(b"OFF 3 1\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2")
@example(b"OFF 3 1\n0 0 0\x1c1\n1 0 0\n1 1 0\n3 0 1 2")
@example(b"OFF 3 1\n0 0 0\n1 0 0\n1 1 0\n3 \xb2 1 2")
def test_whatever_the_bytes_a_mesh_or_a_data_error(tmp_path: Path, content: bytes) -> None:
    try:
        vertices, triangles = _read(tmp_path, content)
    except DataError:
        return
    assert np.isfinite(vertices).all()
    assert 0 <= triangles.min() <= triangles.max() < len(vertices)


@pytest.mark.real_data
@pytest.mark.skipif(REAL_DATA is None, reason="TANGENT_REAL_DATA is not set")
def test_real_meshes_become_spheres() -> None:
    files = sorted((Path(str(REAL_DATA)) / "meshes").glob("*.off"))
    assert len(files) == 7
    for path in files:
        mesh = read_off(path)
        other = trimesh.load(str(path), process=False, force="mesh")
        np.testing.assert_array_equal(mesh.vertices, other.vertices)
        # trimesh puts what was a quadrangle at the end.
        assert {tuple(sorted(t)) for t in mesh.triangles} == {tuple(sorted(t)) for t in other.faces}
        spheres = mesh_spheres(clean_mesh(mesh), (64, 128))
        assert spheres[..., 4].min() > 0
        assert spheres[..., :3].std(axis=(0, 1)).min() > 0.03
