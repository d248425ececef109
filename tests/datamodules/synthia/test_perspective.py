from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.synthia.omnisynthia import OmniSynthia, SynthiaPerspective
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.data_files import names_of
from tests.datamodules.synthia import synthia_format as synthia

CROPS = PerspectiveRepresentation(level=5)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views of two sequences; not to be changed."""
    return synthia.write_views(tmp_path_factory.mktemp("synthia"), {"01": 4, "04": 2})


@pytest.fixture
def broken_root(tmp_path: Path) -> Path:
    """Views of two sequences, to be damaged."""
    return synthia.write_views(tmp_path / "data", {"01": 2, "04": 1})


def two(root: Path, **settings: Any) -> SynthiaPerspective:
    return SynthiaPerspective(
        root, CROPS, **{"train_sequences": ["01"], "test_sequences": ["04"], **settings}
    )


def test_the_photos_are_the_views_of_the_panoramas(root: Path, erp: Any, tmp_path: Path) -> None:
    photos = two(root, frames=2)
    copy = shutil.copytree(root, tmp_path / "copy")
    sequences: Any = {"train_sequences": ["01"], "test_sequences": ["04"]}
    panoramas = OmniSynthia(copy, erp, frames=2, panorama_height=32, **sequences)
    panoramas.prepare_data()
    for split in ("train", "val", "test"):
        views = [f"{name}/{view}" for name in names_of(panoramas, split) for view in "FRBL"]
        assert names_of(photos, split) == views
    assert names_of(photos, "val") == [f"sequence_01/000002/{view}" for view in "FRBL"]


def test_reads_what_was_written(root: Path) -> None:
    source = two(root, inputs=("rgb", "depth")).source("test")
    for index, view in enumerate("FRBL"):
        for frame in (0, 1):
            photo = source.read(4 * frame + index)
            rays = synthia.view_rays(view)
            np.testing.assert_allclose(photo.rgb, synthia.rgb_of(rays), atol=0.5001)
            ids = synthia.labels_of(rays, frame)
            np.testing.assert_array_equal(photo.labels, np.where(ids == 15, 13, ids))
            meters = (500 + 10 * rays[..., 2]) / 100 * np.linalg.norm(rays, axis=-1)
            meters[:2, :3] = 0
            assert photo.depth is not None
            assert photo.depth.dtype == np.uint16
            np.testing.assert_allclose(photo.depth / 512, meters, atol=0.013)  # whole cm
            np.testing.assert_array_equal(photo.depth == 0, meters == 0)
            K = np.array([[synthia.FOCAL, 0, 31.5], [0, synthia.FOCAL, 18.5], [0, 0, 1]])
            np.testing.assert_allclose(photo.camera_matrix, K, rtol=1e-12)
            np.testing.assert_array_equal(source.labels(4 * frame + index), photo.labels)
