from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from torch.utils.data import default_collate

from datamodules.panoramas import Panorama
from datamodules.samples import (
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    EvaluationPanoramas,
    EvaluationSample,
    Normalization,
    TrainingPanoramas,
    TrainingSample,
    normalize,
)
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from datamodules.panoramas import PanoramaSource
    from tangent_train.rendering.representation import Representation

IDENTITY = Normalization((0, 0, 0, 0), (1 / 255, 1 / 255, 1 / 255, 1))


class Positions:
    """Panoramas whose every pixel has its own red, depth and label."""

    def __len__(self) -> int:
        return 3

    def name(self, index: int) -> str:
        return str(index)

    def read(self, index: int) -> Panorama:
        place = np.arange(16 * 32).reshape(16, 32) % 251
        labels = (place + index).astype(np.uint8)
        rgb = np.stack([labels, labels, labels], axis=-1)
        return Panorama(rgb, labels.astype(np.float32) / np.float32(100), labels)

    def read_labels(self, index: int) -> NDArray[np.uint8]:
        return self.read(index).labels


# --- normalization -----------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [True, False])
def test_normalize_against_the_formula(depth: bool) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (2, 4, 5, 3), np.uint8)
    depth_m = rng.uniform(0, 8, (2, 4, 5)).astype(np.float32) if depth else None
    normalization = RGBD_NORMALIZATION if depth else RGB_NORMALIZATION
    images = normalize(rgb, depth_m, normalization)
    assert images.shape == (2, 4 if depth else 3, 4, 5)
    assert images.dtype == np.float32
    assert images.flags.c_contiguous
    for channel, (mean, std) in enumerate(zip(normalization.mean, normalization.std, strict=True)):
        if channel < 3:
            value = rgb[..., channel] / 255
        else:
            assert depth_m is not None
            value = np.minimum(depth_m, 4)
        np.testing.assert_allclose(images[:, channel], (value - mean) / std, atol=1e-5)


def test_missing_depth_counts_as_zero() -> None:
    images = normalize(np.zeros((1, 1, 1, 3), np.uint8), np.zeros((1, 1, 1), np.float32), IDENTITY)
    assert images.ravel().tolist() == [0, 0, 0, 0]


def test_a_config_brings_lists() -> None:
    from_list = Normalization([0.5490, 0.5306, 0.4779], [0.1992, 0.2005, 0.2129])
    assert from_list == RGB_NORMALIZATION
    assert (from_list.channels, RGBD_NORMALIZATION.channels) == (3, 4)


@pytest.mark.parametrize(
    ("mean", "std"),
    [
        ((0, 0, 0), (1, 1, 0)),
        ((0, 0, 0), (1, 1, 1, 1)),
        ((0, 0), (1, 1)),
        ((), ()),
        ((0, 0, float("nan")), (1, 1, 1)),
        ((0, 0, 0), (1, 1, float("nan"))),
    ],
)
def test_impossible_normalization(mean: Any, std: Any) -> None:
    with pytest.raises(SettingError, match="normalization"):
        Normalization(mean, std)


@pytest.mark.parametrize(("depth", "normalization"), [(True, RGB_NORMALIZATION), (False, IDENTITY)])
def test_normalization_of_other_channels(depth: bool, normalization: Normalization) -> None:
    rgb = np.zeros((1, 2, 2, 3), np.uint8)
    with pytest.raises(SettingError, match="channels"):
        normalize(rgb, np.zeros((1, 2, 2), np.float32) if depth else None, normalization)


# --- samples -----------------------------------------------------------------------------------


def _training(strips: Representation, seed: int = 0) -> TrainingPanoramas:
    source: PanoramaSource = Positions()
    return TrainingPanoramas(source, strips, IDENTITY, seed)


def test_training_sample(strips: Representation) -> None:
    sample = _training(strips)[4, 1]
    assert sample.images.shape == (2, 4, 16, 8)
    assert (sample.images.dtype, sample.labels.dtype) == (torch.float32, torch.uint8)
    assert sample.labels.shape == (2, 16, 8)
    assert sample.index == 1
    # The same pixels in all channels.
    torch.testing.assert_close(sample.images[:, 0], sample.labels.float())
    torch.testing.assert_close(sample.images[:, 3], sample.labels.float() / 100)


def test_views_are_those_of_seed_epoch_and_index(strips: Representation) -> None:
    first = _training(strips)[4, 1].labels
    assert torch.equal(first, _training(strips)[4, 1].labels)
    assert not torch.equal(first, _training(strips)[5, 1].labels)
    assert not torch.equal(first, _training(strips, seed=1)[4, 1].labels)


def test_evaluation_sample(strips: Representation) -> None:
    dataset = EvaluationPanoramas(Positions(), strips, IDENTITY)
    sample = dataset[0, 2]
    assert len(dataset) == len(_training(strips)) == 3
    assert sample.images.shape == (4, 4, 16, 8)
    assert sample.index == 2
    np.testing.assert_array_equal(sample.target.numpy(), Positions().read(2).labels)
    joined = torch.cat(list(sample.images[:, 0]), dim=1)
    torch.testing.assert_close(joined, sample.target.float())


def test_samples_collate(strips: Representation) -> None:
    training = _training(strips)
    batch = default_collate([training[0, 0], training[0, 2]])
    assert isinstance(batch, TrainingSample)
    assert batch.images.shape == (2, 2, 4, 16, 8)
    assert batch.labels.dtype == torch.uint8
    assert torch.as_tensor(batch.index).tolist() == [0, 2]
    whole = default_collate([EvaluationPanoramas(Positions(), strips, IDENTITY)[0, 1]])
    assert isinstance(whole, EvaluationSample)
    assert whole.target.shape == (1, 16, 32)
