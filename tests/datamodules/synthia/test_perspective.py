from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from datamodules.synthia.omnisynthia import OmniSynthia
from datamodules.synthia.perspective import SynthiaPerspective
from tangent_train.errors import DataError
from tangent_train.rendering import PerspectiveRepresentation
from tests.datamodules.synthia import synthia_format as synthia

if TYPE_CHECKING:
    from pathlib import Path

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


def names(module: SynthiaPerspective | OmniSynthia, split: Any) -> list[str]:
    source = module.source(split)
    return [source.name(i) for i in range(len(source))]


def test_the_photos_are_the_views_of_the_panoramas(root: Path, strips: Any, tmp_path: Path) -> None:
    photos = two(root, frames=2)
    for name in ("01", "04"):
        folder = synthia.sequence(tmp_path, name)
        folder.mkdir()
        for part in ("RGB", "GT", "Depth", "CameraParams"):
            (folder / part).symlink_to(synthia.sequence(root, name) / part)
    sequences: Any = {"train_sequences": ["01"], "test_sequences": ["04"]}
    panoramas = OmniSynthia(tmp_path, strips, frames=2, panorama_height=32, **sequences)
    panoramas.prepare_data()
    for split in ("train", "val", "test"):
        views = [f"{name}/{view}" for name in names(panoramas, split) for view in "FRBL"]
        assert names(photos, split) == views
    assert names(photos, "val") == [f"sequence_01/000002/{view}" for view in "FRBL"]


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


def test_batches(root: Path) -> None:
    module = two(root, photos_per_step=3)
    module.prepare_data()
    batch = next(iter(module.train_dataloader()))
    images = module.on_after_batch_transfer(batch, 0).images
    assert images.shape == (3, 1, 3, *CROPS.image_size)
    assert batch.labels.max() <= 13
    assert module.samples.normalization.mean == (0.4512, 0.4257, 0.3920)
    assert len(module.class_names) == 14
    assert len(list(module.test_dataloader())) == 8
    assert module.class_weights("log").shape == (14,)


def test_a_broken_view_is_named(broken_root: Path) -> None:
    path = synthia.sequence(broken_root, "04") / "GT/LABELS/Stereo_Left/Omni_B/000000.png"
    content = path.read_bytes()
    path.write_bytes(content[:-30])
    with pytest.raises(DataError, match=r"Omni_B/000000\.png: found .* truncated"):
        two(broken_root).setup()
    labels = np.full((*synthia.SIZE, 3), 300, np.uint16)
    synthia.write_png(path, labels)
    with pytest.raises(DataError, match=r"Omni_B/000000\.png: found labels 300"):
        two(broken_root).source("test").read(2)


def test_nothing_there(tmp_path: Path, broken_root: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: found no such folder.*synthia-dataset"):
        two(tmp_path / "nowhere").setup()
    with pytest.raises(DataError, match=r"02-SUMMER.*Omni_F: found no views.*synthia-dataset"):
        two(broken_root, train_sequences=["02"]).setup()
