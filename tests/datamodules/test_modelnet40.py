from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
import trimesh

from datamodules.core.files import SPLITS, Split
from datamodules.modelnet40.meshes import mesh_spheres, read_mesh
from datamodules.modelnet40.shapes import MODELNET40, STEPS, ModelNet40, find_shapes
from tangent_train.errors import DataError
from tangent_train.rendering import TangentRepresentation, equirect_to_tangent
from tests.datamodules.data_files import names_of
from tests.datamodules.shapes_format import COUNTS, write_tree

PARTS = ("train", "test")


def _touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")


@pytest.mark.parametrize("layout", ["by class", "by split"])
def test_both_layouts_are_found(tmp_path: Path, layout: Literal["by class", "by split"]) -> None:
    root = write_tree(tmp_path, layout)
    _touch(root / "README.txt")
    _touch(root / "spheres_64x128/chair/train/chair_0001.npy")
    _touch(root / "modelnet40_train/._chair_0001.off" if layout == "by split" else root / ".x.off")
    _touch(root / ("modelnet40_test/list.txt" if layout == "by split" else "chair/train/a.txt"))
    found = find_shapes(root)
    counted = Counter((shape.label, shape.part) for shape in found)
    expected = {(c, p): n for c, both in COUNTS.items() for p, n in zip(PARTS, both, strict=True)}
    assert counted == expected
    for shape in found:
        assert shape.path == root / f"{shape.name}.off"
    assert found == sorted(found, key=lambda shape: (shape.part, shape.name))


MakeModule = Callable[..., ModelNet40]

LEVEL = 3
TRAINING = sum(train for train, _ in COUNTS.values())
TEST = sum(test for _, test in COUNTS.values())


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set with its spheres; not to be changed."""
    root = write_tree(tmp_path_factory.mktemp("shapes"))
    ModelNet40(root, TangentRepresentation(0, LEVEL)).prepare_data()
    return root


@pytest.fixture
def make_module(root: Path) -> MakeModule:
    def make(rotation: Any = "none", **settings: Any) -> ModelNet40:
        return ModelNet40(
            root, TangentRepresentation(0, LEVEL, random_rotation=rotation), **settings
        )

    return make


def _labels(module: ModelNet40, split: Split) -> list[int]:
    return [module.class_names.index(mesh.label) for mesh in module.splits()[split]]


def test_validation_is_drawn_from_every_class_alike(make_module: MakeModule) -> None:
    drawn = set()
    for seed in range(4):
        module = make_module(val_fraction=0.34, seed=seed)
        labels = _labels(module, "val")
        # A third of 6, 4 and 5.
        assert [labels.count(k) for k in range(3)] == [2, 1, 2]
        drawn.add(tuple(names_of(module, "val")))
        again = make_module(val_fraction=0.34, seed=seed)
        assert names_of(again, "val") == names_of(module, "val")
        names = {name for split in SPLITS for name in names_of(module, split)}
        assert len(names) == sum(len(_labels(module, split)) for split in SPLITS) == TRAINING + TEST
        assert all("/test/" in name for name in names_of(module, "test"))
    assert len(drawn) > 1
    assert make_module(val_fraction=0).val_dataloader() == []


def test_classes_before_there_are_files(tmp_path: Path) -> None:
    module = ModelNet40(tmp_path / "ModelNet40", TangentRepresentation(0, LEVEL))
    assert module.class_names == MODELNET40
    for use in (module.setup, module.prepare_data):
        with pytest.raises(DataError, match=r"no .*princeton"):
            use()


def test_views_are_those_of_the_float_spheres(make_module: MakeModule, root: Path) -> None:
    """All six channels, against a rendering in float64 by the torch renderer."""
    module = make_module()
    batch = module.on_after_batch_transfer(next(iter(module.test_dataloader())), 0)
    mesh = read_mesh(root / f"{module.dataset('test').name(3)}.off")
    spheres = torch.from_numpy(mesh_spheres(mesh, (16, 32))).movedim(-1, 0)
    views = equirect_to_tangent(spheres, module.representation.grid)
    normalization: Any = module.normalization
    mean, std = torch.tensor([normalization.mean, normalization.std])[..., None, None]
    torch.testing.assert_close(
        batch.images[3], ((views - mean) / std).float(), atol=4 / STEPS / 0.19, rtol=0
    )


def test_training_is_rotated_anew_every_time_and_evaluation_is_not(make_module: MakeModule) -> None:
    plain, rotated = make_module(), make_module("so3")
    first = plain.dataset("train")
    assert torch.equal(first[0, 4].images, first[1, 4].images)
    again = rotated.dataset("train")
    assert not torch.equal(again[0, 4].images, again[1, 4].images)
    assert torch.equal(again[0, 4].images, again[0, 4].images)
    for split in SPLITS[1:]:
        one, other = plain.dataset(split)[0], rotated.dataset(split)[0]
        assert torch.equal(one.images, other.images)


@pytest.mark.parametrize("rotation", ["so3", "yaw"])
def test_views_of_a_rotated_shape_are_views_of_its_rotated_mesh(
    tmp_path: Path, rotation: Any
) -> None:
    """Independent of the renderers: the mesh itself is rotated, and rays are cast again."""
    representation = TangentRepresentation(0, 5)
    ball = trimesh.creation.icosphere(4)
    x, y = ball.vertices[:, :1], ball.vertices[:, 1:2]
    ball.vertices = ball.vertices * (0.4, 0.7, 1) * (1 + 0.3 * x + 0.2 * y)
    root = write_tree(tmp_path, counts={"bottle": (1, 2)})
    for path in (root / "bottle/test").iterdir():
        ball.export(path)
    module = ModelNet40(root, representation, test_rotation=rotation, val_fraction=0)
    module.prepare_data()
    samples: Any = module.dataset("test")
    for index in range(2):
        rotated = samples.shape_rotation(index)
        assert bool(rotated[2, 2] > 1 - 1e-12) is (rotation == "yaw")
        mesh = read_mesh(root / f"{module.dataset('test').name(index)}.off")
        mesh.vertices = mesh.vertices @ rotated.T
        steps = np.rint(mesh_spheres(mesh, (64, 128)) * STEPS).astype(np.uint16)
        (views,) = representation.view_sets()
        expected = np.concatenate(
            [views.render(steps[..., k : k + 3], "bilinear") for k in (0, 3)], axis=-1
        )
        found = samples[0, index].images.numpy() / STEPS
        assert np.abs(found - expected / STEPS).mean() < 0.01  # facets have edges
        upright = module.dataset("test").read(index).spheres
        before = views.render(np.ascontiguousarray(upright[..., :3]), "bilinear") / STEPS
        assert np.abs(before - expected[..., :3] / STEPS).mean() > 0.05
