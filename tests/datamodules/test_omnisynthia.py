from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.core.files import SPLITS
from datamodules.synthia.omnisynthia import OmniSynthia, SynthiaPerspective
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering import EquirectRepresentation, PerspectiveRepresentation
from tests.datamodules import synthia_format as synthia
from tests.datamodules.data_files import names_of, read_png

SEQUENCES: dict[str, Any] = {"train_sequences": ["01"], "test_sequences": ["04"]}
CROPS = PerspectiveRepresentation(level=5)
FRAMES = {"01": 5, "02": 3, "04": 2, "05": 2, "06": 4}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Panoramas as published; not to be changed."""
    return synthia.write_panoramas(tmp_path_factory.mktemp("omnisynthia"), FRAMES)


def two(root: Path, erp: Any, **settings: Any) -> OmniSynthia:
    return OmniSynthia(root, erp, **{**SEQUENCES, **settings})


def classes_of(ids: NDArray[Any]) -> NDArray[Any]:
    """Return the labels of ids: twelve classes and traffic lights; other ids are unknown."""
    return np.where(ids == 15, 13, np.where(ids > 12, 0, ids))


# --- splits --------------------------------------------------------------------------------------


def test_splits_follow_the_authors(root: Path, erp: Any) -> None:
    module = OmniSynthia(root, erp)
    module.prepare_data()  # nothing to make
    module.setup("fit")
    splits = {split: names_of(module, split) for split in SPLITS}
    assert splits["val"] == [
        "sequence_01/000004",
        "sequence_02/000002",
        "sequence_05/000001",
        "sequence_06/000003",
    ]
    assert splits["test"] == ["sequence_04/000000", "sequence_04/000001"]
    assert len(splits["train"]) == 14 - 4
    assert len({name for split in splits.values() for name in split}) == sum(FRAMES.values())


# --- reading -------------------------------------------------------------------------------------


def test_reads_what_was_written(root: Path) -> None:
    module = OmniSynthia(root, EquirectRepresentation(4), inputs=("rgb", "depth"))
    source = module.dataset("test")
    panorama = source.read(1)
    pano = synthia.sequence(root, "04") / "pano"
    ids = read_png(pano / "GT" / "LABELS_Correct" / "000001.png")
    assert {15, 255} <= set(np.unique(ids).tolist())
    expected = classes_of(ids)
    np.testing.assert_array_equal(panorama.labels, expected)
    rgb = read_png(pano / "RGB" / "000001.png")[..., ::-1]
    np.testing.assert_array_equal(panorama.rgb, rgb)
    assert panorama.depth is not None
    meters = read_png(pano / "Depth" / "000001.png") / 100
    assert np.abs(panorama.depth / 512 - meters).max() <= 0.5 / 512


# --- photos --------------------------------------------------------------------------------------


def test_the_photos_are_the_views_of_the_panoramas(erp: Any, tmp_path: Path) -> None:
    synthia.write_views(tmp_path, {"01": 4, "04": 2})
    photos = SynthiaPerspective(tmp_path, CROPS, frames=2, **SEQUENCES)
    panoramas = OmniSynthia(tmp_path, erp, frames=2, panorama_height=32, **SEQUENCES)
    panoramas.prepare_data()
    for split in SPLITS:
        views = [f"{name}/{view}" for name in names_of(panoramas, split) for view in "FRBL"]
        assert names_of(photos, split) == views
    assert names_of(photos, "val") == [f"sequence_01/000002/{view}" for view in "FRBL"]


def test_photos_are_what_was_written(root: Path) -> None:
    photos = SynthiaPerspective(root, CROPS, inputs=("rgb", "depth"), **SEQUENCES)
    source = photos.dataset("test")
    for index, view in enumerate("FRBL"):
        for frame in (0, 1):
            photo = source.read(4 * frame + index)
            rays = synthia.view_rays(view)
            np.testing.assert_allclose(photo.rgb, synthia.rgb_of(rays), atol=0.5001)
            ids = synthia.labels_of(rays, frame)
            np.testing.assert_array_equal(photo.labels, classes_of(ids))
            meters = (500 + 10 * rays[..., 2]) / 100 * np.linalg.norm(rays, axis=-1)
            meters[:2, :3] = 0
            assert photo.depth is not None
            assert photo.depth.dtype == np.uint16
            np.testing.assert_allclose(photo.depth / 512, meters, atol=0.013)  # whole cm
            np.testing.assert_array_equal(photo.depth == 0, meters == 0)
            K = np.array([[synthia.FOCAL, 0, 31.5], [0, synthia.FOCAL, 18.5], [0, 0, 1]])
            np.testing.assert_allclose(photo.camera_matrix, K, rtol=1e-12)


# --- making --------------------------------------------------------------------------------------


def test_panoramas_are_made_from_views(tmp_path: Path, erp: Any) -> None:
    root = synthia.write_views(tmp_path, {"01": 3})
    synthia.write_panoramas(root, {"04": 1})
    # Numbers, as YAML reads them.
    sequences = {"train_sequences": [1], "test_sequences": [4]}
    module = two(root, erp, panorama_height=64, frames=2, **sequences)
    with pytest.raises(DataError, match=r"01-SUMMER: found no panoramas"):
        module.setup()
    module.prepare_data()
    module.setup("fit")
    assert names_of(module, "train") == ["sequence_01/000000"]
    assert names_of(module, "val") == ["sequence_01/000002"]
    labels = module.dataset("train").read(0).labels
    assert labels.shape == (16, 32)
    assert set(np.unique(labels).tolist()) == set(range(14))
    two(root, erp, panorama_height=64, frames=2).make_files()
    with pytest.raises(SettingError, match="height: found 2096; expected 64"):
        two(root, erp, frames=2).make_files()
