from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datamodules.modelnet40.meshes import clean_mesh, mesh_spheres
from datamodules.synthshapes import CLASSES, ShapeSettings, generate_shapes, make_shape
from tests.datamodules.data_files import contents


def test_another_seed_or_more_shapes(tiny_shapes: Path, tmp_path: Path) -> None:
    generate_shapes(tmp_path / "more", ShapeSettings(3, 3, 1))
    more, fewer = contents(tmp_path / "more"), contents(tiny_shapes)
    assert more["cup/train/cup_0002.off"] == fewer["cup/train/cup_0002.off"]
    assert more["cup/train/cup_0003.off"] == fewer["cup/test/cup_0003.off"]
    generate_shapes(tmp_path / "other", ShapeSettings(4, 2, 1))
    other = contents(tmp_path / "other")
    assert not any(other[name] == fewer[name] for name in fewer if name.endswith(".off"))


# --- shapes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("label", CLASSES)
def test_individuals_can_be_used_and_differ(label: str) -> None:
    images = []
    for number in range(8):
        mesh = make_shape(0, label, number)
        assert np.isfinite(mesh.vertices).all()
        assert 24 <= len(mesh.faces) < 5000
        images.append(mesh_spheres(clean_mesh(mesh), (8, 16)))
    apart = [np.abs(a - b).mean() for k, a in enumerate(images) for b in images[:k]]
    assert min(apart) > 0.005
