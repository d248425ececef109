from __future__ import annotations

import json
import os
import shutil
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from datamodules.modelnet40 import sphere_store
from datamodules.modelnet40.mesh_spheres import clean_mesh, mesh_spheres
from datamodules.modelnet40.off_files import read_off
from datamodules.modelnet40.shape_files import ShapeFile, find_shapes
from datamodules.modelnet40.sphere_files import STEPS, is_current, make_sphere, read_sphere
from datamodules.modelnet40.sphere_store import Shapes, SphereFolder
from tangent_train.errors import DataError, SettingError
from tests.datamodules.modelnet40.shapes_format import write_tree

if TYPE_CHECKING:
    from pathlib import Path

SHAPE = (8, 16)


@pytest.fixture
def meshes(tmp_path: Path) -> list[ShapeFile]:
    return find_shapes(write_tree(tmp_path / "data"))


@pytest.fixture
def folder(tmp_path: Path) -> SphereFolder:
    return SphereFolder(tmp_path / "spheres", SHAPE)


def _times(folder: SphereFolder) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.folder.rglob("*.npy")}


def _prepare(folder: SphereFolder, meshes: list[ShapeFile], **settings: Any) -> int:
    return folder.prepare(meshes, **{"workers": 0, "progress": False, **settings})


# --- one file ----------------------------------------------------------------------------------


def test_a_file_holds_the_spheres(meshes: list[ShapeFile], tmp_path: Path) -> None:
    target = tmp_path / "spheres.npy"
    assert make_sphere(meshes[0].path, target, SHAPE) is None
    steps = read_sphere(target, SHAPE)
    expected = mesh_spheres(clean_mesh(read_off(meshes[0].path)), SHAPE)
    assert np.abs(steps / STEPS - expected).max() <= 0.5 / STEPS + 1e-12
    assert steps.max() < 2**15  # torch takes them as int16
    np.testing.assert_array_equal(np.load(target), steps)


@pytest.mark.parametrize("damage", ["", "half", "tail", "empty", "text"])
def test_what_is_broken_is_not_current(
    meshes: list[ShapeFile], tmp_path: Path, damage: str
) -> None:
    source, target = meshes[0].path, tmp_path / "spheres.npy"
    assert not is_current(source, target)
    make_sphere(source, target, SHAPE)
    assert is_current(source, target)
    content = target.read_bytes()
    damaged = {
        "": content,
        "half": content[: len(content) // 2],
        "tail": content[:-5],
        "empty": b"",
        "text": b'a\n{"made from": 3}\n',
    }
    target.write_bytes(damaged[damage])
    assert is_current(source, target) is (damage == "")


def test_another_version_of_the_mesh_is_noticed(meshes: list[ShapeFile], tmp_path: Path) -> None:
    source, target = meshes[0].path, tmp_path / "spheres.npy"
    make_sphere(source, target, SHAPE)
    status = source.stat()
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns - 10**9))  # older, as by cp -p
    assert not is_current(source, target)
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert is_current(source, target)
    source.write_text(source.read_text() + "# longer\n")
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert not is_current(source, target)


def test_reading_what_is_no_sphere(tmp_path: Path) -> None:
    path = tmp_path / "spheres.npy"
    with pytest.raises(DataError, match=r"nothing to read.*tangent-prepare"):
        read_sphere(path, SHAPE)
    path.write_bytes(b"\x93NUMPY")
    with pytest.raises(DataError, match="nothing to read"):
        read_sphere(path, SHAPE)
    np.save(path, np.zeros((4, 8, 6), np.uint16))
    with pytest.raises(DataError, match=r"found uint16 \(4, 8, 6\); expected uint16 \(8, 16, 6\)"):
        read_sphere(path, SHAPE)


# --- the folder --------------------------------------------------------------------------------


def test_made_once(folder: SphereFolder, meshes: list[ShapeFile]) -> None:
    assert _prepare(folder, meshes) == len(meshes)
    before = _times(folder)
    assert set(before) == {folder.path(mesh) for mesh in meshes}
    assert _prepare(folder, meshes) == 0
    assert _times(folder) == before
    folder.path(meshes[3]).unlink()
    os.utime(meshes[5].path)
    assert _prepare(folder, meshes) == 2
    changed = {path for path, time in _times(folder).items() if before[path] != time}
    assert changed == {folder.path(meshes[3]), folder.path(meshes[5])}


@pytest.mark.slow  # the processes import OpenCV, SciPy and Embree
def test_the_same_bytes_for_any_number_of_processes(
    folder: SphereFolder,
    meshes: list[ShapeFile],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sphere_store, "_PER_PROCESS", 1)
    meshes[2].path.write_text("OFF\n")
    other = SphereFolder(tmp_path / "other", SHAPE)
    _prepare(folder, meshes, workers=2)
    _prepare(other, meshes, workers=0)
    for path in sorted(folder.folder.rglob("*.*")):
        same = other.folder / path.relative_to(folder.folder)
        assert path.read_bytes() == same.read_bytes()
    assert len(list(other.folder.rglob("*.npy"))) == len(meshes) - 1


def test_unusable_meshes_are_named_counted_and_left_out(
    folder: SphereFolder, meshes: list[ShapeFile], capsys: pytest.CaptureFixture[str]
) -> None:
    broken = [meshes[1], meshes[4]]
    broken[0].path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n1 nan 0\n3 0 1 2\n")
    broken[1].path.write_text("OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n")
    assert _prepare(folder, meshes, progress=True) == len(meshes)
    printed = capsys.readouterr().out
    assert f"2 of {len(meshes)} shapes cannot be used:" in printed
    assert f"{broken[0].path}, line 5: found 'nan'" in printed
    assert "extent of 0" in printed
    listed = json.loads((folder.folder / "unusable.json").read_text())
    assert set(listed) == {mesh.name for mesh in broken}
    assert folder.usable(meshes) == [mesh for mesh in meshes if mesh not in broken]
    # They are not tried again, and said again.
    assert _prepare(folder, meshes, progress=True) == 0
    assert "2 of" in capsys.readouterr().out
    # Mended ones are.
    shutil.copy(meshes[0].path, broken[0].path)
    assert _prepare(folder, meshes, progress=True) == 1
    assert "1 of" in capsys.readouterr().out
    shutil.copy(meshes[0].path, broken[1].path)
    assert _prepare(folder, meshes, progress=True) == 1
    assert "cannot" not in capsys.readouterr().out
    assert folder.usable(meshes) == meshes
    assert not (folder.folder / "unusable.json").exists()


def test_a_link_that_leads_nowhere_is_unusable(
    folder: SphereFolder, meshes: list[ShapeFile], tmp_path: Path
) -> None:
    meshes[0].path.unlink()
    meshes[0].path.symlink_to(tmp_path / "nowhere")
    _prepare(folder, meshes)
    assert folder.usable(meshes) == meshes[1:]
    assert _prepare(folder, meshes) == 0


def test_an_interrupt_leaves_whole_files_and_work_goes_on(
    folder: SphereFolder, meshes: list[ShapeFile], monkeypatch: pytest.MonkeyPatch
) -> None:
    meshes[0].path.write_text("broken")
    made: list[Path] = []

    def interrupted(source: Path, target: Path, shape: tuple[int, int]) -> str | None:
        if len(made) == 4:
            raise KeyboardInterrupt
        made.append(target)
        return make_sphere(source, target, shape)

    with monkeypatch.context() as patch:
        patch.setattr(sphere_store, "make_sphere", interrupted)
        with pytest.raises(KeyboardInterrupt):
            _prepare(folder, meshes)
    assert set(_times(folder)) == set(made[1:])
    assert not list(folder.folder.rglob(".partial*"))
    assert folder.usable(meshes) == meshes[1:]
    assert _prepare(folder, meshes) == len(meshes) - 4


def test_nowhere_to_write(
    folder: SphereFolder, meshes: list[ShapeFile], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.folder.write_text("mine")
    with pytest.raises(DataError, match=r"found a file; .*data\.store"):
        _prepare(folder, meshes)
    folder.folder.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        with pytest.raises(DataError, match=r"may not be written to; .*data\.store"):
            _prepare(folder, meshes)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
        with pytest.raises(DataError, match="0 MB free; expected 0 MB for the spheres of 21"):
            _prepare(folder, meshes)
    assert not folder.folder.exists()


@pytest.mark.parametrize("content", ["[]", "{half", '{"a": 3}', '{"a": {"why": 1}}'])
def test_a_list_of_unusable_meshes_that_is_none(
    folder: SphereFolder, meshes: list[ShapeFile], content: str
) -> None:
    folder.folder.mkdir()
    (folder.folder / "unusable.json").write_text(content)
    with pytest.raises(DataError, match=r"unusable\.json: found something else"):
        _prepare(folder, meshes)


def test_a_negative_number_of_workers(folder: SphereFolder, meshes: list[ShapeFile]) -> None:
    with pytest.raises(SettingError, match="workers: found -1"):
        _prepare(folder, meshes, workers=-1)


# --- reading -----------------------------------------------------------------------------------


def test_shapes_by_number(folder: SphereFolder, meshes: list[ShapeFile]) -> None:
    _prepare(folder, meshes)
    paths = [folder.path(mesh) for mesh in meshes]
    shapes = Shapes([m.name for m in meshes], list(range(len(meshes))), paths, SHAPE)
    kept = shapes.remembered()
    assert len(shapes) == len(kept) == len(meshes)
    first = shapes.read(2)
    np.testing.assert_array_equal(first, read_sphere(paths[2], SHAPE))
    assert shapes.name(2) == kept.name(2) == meshes[2].name
    assert kept.labels == shapes.labels
    for path in paths:
        path.unlink()
    np.testing.assert_array_equal(kept.read(2), first)
    with pytest.raises(DataError, match="tangent-prepare"):
        shapes.read(2)
