from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from datamodules import SynthShapes
from datamodules.modelnet40.off_files import write_off
from datamodules.modelnet40.shape_files import find_shapes
from datamodules.synthshapes import generate
from datamodules.synthshapes.families import CLASSES
from datamodules.synthshapes.generate import MANIFEST, generate_shapes, plan_shapes
from datamodules.synthshapes.settings import ShapeSettings
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import TangentRepresentation

if TYPE_CHECKING:
    from datamodules.core.split_module import Split

TINY = ShapeSettings(seed=3, train=2, test=1)


def contents(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "tiny"
    generate_shapes(root, TINY, workers=0, progress=False)
    return root


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    root = tmp_path / "copy"
    for name, content in contents(tiny).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


def test_the_tree_is_that_of_the_real_set(tiny: Path) -> None:
    shapes = find_shapes(tiny)
    assert len(shapes) == 30
    assert {shape.label for shape in shapes} == set(CLASSES)
    names = {shape.name for shape in shapes if shape.label == "cup"}
    assert names == {"cup/train/cup_0001", "cup/train/cup_0002", "cup/test/cup_0003"}
    assert json.loads((tiny / MANIFEST).read_text())["settings"] == TINY.as_dict()
    assert len(contents(tiny)) == 31


@pytest.mark.slow  # the processes import trimesh
def test_the_same_bytes_for_any_number_of_processes(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generate, "_PER_PROCESS", 1)
    generate_shapes(tmp_path / "same", TINY, workers=2, progress=True)
    assert contents(tmp_path / "same") == contents(tiny)


def test_another_seed_or_more_shapes(tiny: Path, tmp_path: Path) -> None:
    generate_shapes(tmp_path / "more", ShapeSettings(3, 3, 1), workers=0, progress=False)
    more, own = contents(tmp_path / "more"), contents(tiny)
    assert more["cup/train/cup_0002.off"] == own["cup/train/cup_0002.off"]
    assert more["cup/train/cup_0003.off"] == own["cup/test/cup_0003.off"]
    generate_shapes(tmp_path / "other", ShapeSettings(4, 2, 1), workers=0, progress=False)
    other = contents(tmp_path / "other")
    assert not any(other[name] == own[name] for name in own)


@pytest.mark.parametrize("damage", ["removed", "halved", "empty"])
def test_missing_and_broken_files_are_made_again(tiny: Path, copy: Path, damage: str) -> None:
    file = copy / "vase/test/vase_0003.off"
    kept = copy / "vase/train/vase_0001.off"
    before = kept.stat().st_mtime_ns
    content = file.read_bytes()
    if damage == "removed":
        file.unlink()
    else:
        file.write_bytes(content[: len(content) // 2].rstrip() if damage == "halved" else b"")
    generate_shapes(copy, TINY, workers=0, progress=False)
    assert contents(copy) == contents(tiny)
    assert kept.stat().st_mtime_ns == before


def test_an_interrupt_leaves_whole_files_and_work_goes_on(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "interrupted"
    made: list[Path] = []

    def interrupted(path: Path, mesh: Any) -> None:
        if len(made) == 5:
            raise KeyboardInterrupt
        made.append(path)
        write_off(path, mesh)

    with monkeypatch.context() as patch:
        patch.setattr(generate, "write_off", interrupted)
        with pytest.raises(KeyboardInterrupt):
            generate_shapes(root, TINY, workers=0, progress=False)
    left = contents(root)
    assert len(left) == 6
    assert left.items() <= contents(tiny).items()
    generate_shapes(root, TINY, workers=0, progress=False)
    assert contents(root) == contents(tiny)


def test_a_folder_of_other_settings_or_of_someone_else_is_left_alone(
    copy: Path, tmp_path: Path
) -> None:
    before = contents(copy)
    with pytest.raises(DataError, match="found train=2; expected train=9"):
        generate_shapes(copy, ShapeSettings(3, 9, 1))
    assert contents(copy) == before
    real = tmp_path / "ModelNet40"
    (real / "airplane/train").mkdir(parents=True)
    with pytest.raises(DataError, match=r"not SynthShapes'.*airplane"):
        generate_shapes(real, TINY)
    assert contents(real) == {}


@pytest.mark.parametrize(
    ("name", "value"), [("seed", -1), ("train", 0), ("test", 0), ("train", 1.5), ("test", True)]
)
def test_impossible_settings(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=rf"data\.shapes\.{name}: found {value}"):
        ShapeSettings(**{name: value})


def test_a_negative_number_of_workers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="workers: found -1"):
        generate_shapes(tmp_path, TINY, workers=-1)
    assert contents(tmp_path) == {}


def test_plans_follow_the_classes() -> None:
    plans = plan_shapes(TINY)
    assert [plan.label for plan in plans[::3]] == list(CLASSES)
    assert plans[2].file == "airplane/test/airplane_0003.off"


# --- as a data module --------------------------------------------------------------------------


def test_shapes_are_made_then_read_like_the_real_set(tmp_path: Path) -> None:
    settings = {"seed": 3, "train": 4, "test": 1}
    representation = TangentRepresentation(0, 3)
    module = SynthShapes(tmp_path / "shapes", representation, settings, validation_fraction=0.25)
    assert module.class_names == CLASSES
    with pytest.raises(DataError, match="no such folder"):
        module.setup()
    module.prepare_all()
    splits: tuple[Split, ...] = ("train", "val", "test")
    assert [len(module.source(split)) for split in splits] == [30, 10, 10]
    assert next(iter(module.test_dataloader())).images.shape == (10, 20, 8, 8, 6)
    before = contents(tmp_path / "shapes")
    again = SynthShapes(tmp_path / "shapes", representation, ShapeSettings(**settings))
    again.prepare_data()  # the spheres in the folder are no foreign files
    assert contents(tmp_path / "shapes") == before


def test_default_settings(tmp_path: Path) -> None:
    module = SynthShapes(tmp_path, TangentRepresentation(0, 3))
    assert module.shapes == ShapeSettings()
