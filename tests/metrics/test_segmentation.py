from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchmetrics.classification import MulticlassAccuracy
from torchmetrics.utilities import dim_zero_cat

from tangent_train.errors import SettingError
from tangent_train.heads import ImageClassHead
from tangent_train.metrics.collected import ClassificationMetric, SegmentationMetric
from tangent_train.metrics.image_sums import drawn_scores, intervals
from tangent_train.metrics.scores import BAND_EDGES_DEG
from tangent_train.metrics.segmentation import segmentation_scores

CLASSES = 5


def _panoramas() -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Prediction and truth of panoramas of uneven sizes; both have unknown pixels."""
    rng = np.random.default_rng(3)
    shapes = [(12, 24), (30, 60), (7, 15)]
    return [(rng.integers(0, CLASSES, shape), rng.integers(0, CLASSES, shape)) for shape in shapes]


def _counted(pairs: list[tuple[NDArray[np.int64], NDArray[np.int64]]]) -> SegmentationMetric:
    metric = SegmentationMetric(CLASSES)
    for prediction, truth in pairs:
        metric.update(torch.from_numpy(prediction), torch.from_numpy(truth))
    return metric


def test_scores_equal_plain_numpy_over_the_whole_data_set() -> None:
    pairs = _panoramas()
    prediction = np.concatenate([p.ravel() for p, _ in pairs])
    truth = np.concatenate([t.ravel() for _, t in pairs])
    prediction, truth = prediction[truth > 0], truth[truth > 0]
    scores = segmentation_scores(_counted(pairs).compute().pixels)
    for k in range(1, CLASSES):
        hits = np.sum((prediction == k) & (truth == k))
        union = np.sum((prediction == k) | (truth == k))
        assert scores.of_classes["iou"][k - 1] == pytest.approx(hits / union)
        assert scores.of_classes["accuracy"][k - 1] == pytest.approx(hits / np.sum(truth == k))
        assert scores.share[k - 1] == pytest.approx(np.mean(truth == k))
    for mean, name in (("miou", "iou"), ("macc", "accuracy")):
        assert scores.means[mean] == pytest.approx(scores.of_classes[name].mean())


@pytest.mark.parametrize(("absent", "mean"), [("skip", (1 + 0.5) / 2), ("zero", (1 + 0.5 + 0) / 3)])
def test_absent_classes_are_skipped_or_count_as_zero(absent: Any, mean: float) -> None:
    confusion = np.zeros((4, 4))
    confusion[1, 1] = 10
    confusion[2, 2], confusion[2, 3] = 5, 5
    confusion[0, 3] = 100  # unknown truth is ignored
    assert segmentation_scores(confusion, absent).means["miou"] == pytest.approx(mean)


def test_scores_without_labels_are_nan_or_zero() -> None:
    empty = np.zeros((4, 4))
    scores = segmentation_scores(empty)
    assert np.isnan([*scores.means.values(), *scores.of_classes["iou"]]).all()
    assert scores.share.tolist() == [0, 0, 0]
    assert segmentation_scores(empty, "zero").means["miou"] == 0


def test_solid_angles_give_the_area_on_the_sphere() -> None:
    height, width = 64, 128
    truth = torch.ones(height, width, dtype=torch.int64)
    truth[: height // 4] = 2  # above 45°: (1 − sin 45°)/2 of the sphere, a quarter of the rows
    metric = SegmentationMetric(3)
    metric.update(truth, truth)
    matrices = metric.compute()
    share = matrices.of_images[0, 1, 2] / (4 * np.pi)
    np.testing.assert_allclose(share, [(1 + np.sqrt(0.5)) / 2, (1 - np.sqrt(0.5)) / 2], rtol=1e-12)
    np.testing.assert_array_equal(matrices.pixels.diagonal()[1:], [3 * 64 * 32, 64 * 32])


def test_a_row_on_the_edge_of_two_bands_counts_in_the_northern_one() -> None:
    """Row i of H has its center at 90° − (2i + 1) · 90°/H, here in whole numbers of H-ths."""
    for height in range(1, 64):
        expected = np.zeros(6, np.int64)
        for row in range(height):
            above = [e for e in BAND_EDGES_DEG[1:-1] if (2 * row + 1) * 90 > (90 - e) * height]
            expected[len(above)] += 2 * height
        metric = SegmentationMetric(2)
        metric.update(*[torch.ones(height, 2 * height, dtype=torch.int64)] * 2)
        np.testing.assert_array_equal(metric.compute().bands[:, 1, 1], expected)


def test_large_counts_stay_exact() -> None:
    # Float32 cannot count beyond 2**24: a data set has more pixels of one class than that.
    metric = SegmentationMetric(2)
    metric.pixels += 2**24
    metric.bands += 2**24
    metric.update(torch.ones(1, 2, dtype=torch.int64), torch.ones(1, 2, dtype=torch.int64))
    metric.update(torch.ones(1, 1, 1, dtype=torch.int64), torch.ones(1, 1, 1, dtype=torch.int64))
    matrices = metric.compute()
    assert int(matrices.pixels[1, 1]) == 2**24 + 3
    assert int(matrices.bands[:, 1, 1].sum()) == 6 * 2**24 + 2
    assert matrices.of_images.dtype == np.float64


@pytest.mark.filterwarnings("ignore:The ``compute`` method .* was called before")
def test_processes_together_count_every_image_once() -> None:
    """Three processes: with two panoramas, with one, and without."""
    whole = _counted(_panoramas()).compute()
    parts = [_counted(_panoramas()[:2]), _counted(_panoramas()[2:]), SegmentationMetric(CLASSES)]
    states = [[dim_zero_cat(getattr(p, name)) for p in parts] for name in parts[0]._reductions]
    for part in parts:
        gathered = iter(states)
        part.dist_sync_fn = lambda state, group=None, given=gathered: next(given)
        part.distributed_available_fn = lambda: True
        found = part.compute()
        np.testing.assert_array_equal(found.pixels, whole.pixels)
        np.testing.assert_array_equal(found.bands, whole.bands)
        np.testing.assert_array_equal(found.of_images, whole.of_images)


def _random_images(count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Confusion matrices, and their sums as `SegmentationMetric` keeps them; class 4 is rare."""
    rng = np.random.default_rng(11)
    confusions = rng.integers(0, 90, (count, CLASSES, CLASSES))
    confusions[:, 0] = 0
    confusions[1:, 4] = 0
    sums = [(c[1:].sum(1), c[:, 1:].sum(0), c.diagonal()[1:]) for c in confusions]
    return confusions, np.array(sums, np.float64)


@pytest.mark.parametrize("absent", ["skip", "zero"])
def test_intervals_are_those_of_data_sets_drawn_one_after_another(absent: Any) -> None:
    confusions, of_images = _random_images(6)
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(250):
        whole = np.zeros((CLASSES, CLASSES))
        times = rng.multinomial(6, [1 / 6] * 6)
        for count, confusion in zip(times, confusions, strict=True):
            whole += count * confusion
        scores.append([*segmentation_scores(whole, absent).means.values()])
    low, high = np.percentile(scores, [2.5, 97.5], axis=0)
    found = intervals(drawn_scores({"pixels": of_images}, absent, draws=250, seed=5))
    assert found["miou"] == pytest.approx((low[0], high[0]), rel=1e-12)
    assert found["macc"] == pytest.approx((low[1], high[1]), rel=1e-12)
    assert low[0] < high[0]


def test_bad_input_is_refused() -> None:
    metric = SegmentationMetric(3)
    ones = torch.ones(2, 4, dtype=torch.int64)
    for strange in (3, -1):  # −1 would count as the last class of the row above
        found = f"class index: found {min(strange, 1)} to {max(strange, 1)}; expected 0 to 2"
        one_of_them = ones.clone()
        one_of_them[1, 2] = strange
        for pair in ((one_of_them, ones), (ones, one_of_them)):
            with pytest.raises(SettingError, match=found):
                metric.update(*pair)
    assert len(metric.compute().of_images) == 0


def test_photos_are_counted_like_panoramas_without_latitudes_and_solid_angles() -> None:
    rng = np.random.default_rng(5)
    prediction, truth = rng.integers(1, CLASSES, (3, 8, 8)), rng.integers(0, CLASSES, (3, 8, 8))
    photo = _counted([(prediction, truth)]).compute()
    as_one = _counted([(np.hstack(list(prediction)), np.hstack(list(truth)))]).compute()
    np.testing.assert_array_equal(photo.pixels, as_one.pixels)
    assert len(photo.of_images) == 1, "three crops of one photo"
    assert not photo.of_images[:, 1].any()
    assert not photo.bands.any()
    assert as_one.of_images[:, 1].any()


def test_scores_equal_torchmetrics_over_the_whole_data_set() -> None:
    generator = torch.Generator().manual_seed(1)
    prediction = torch.randint(0, 6, (38,), generator=generator)
    truth = torch.randint(0, 4, (38,), generator=generator)  # without the last class
    truth[20] = prediction[20] = 4  # a class of a single image
    metric = ClassificationMetric(6)
    for batch in (slice(7), slice(7, 8), slice(8, None)):
        metric.update(prediction[batch], truth[batch])
    matrix = metric.compute()
    for cell in np.ndindex(6, 6):
        assert matrix[cell] == ((truth == cell[0]) & (prediction == cell[1])).sum()
    scores = ImageClassHead([str(k) for k in range(6)]).scores(matrix)
    overall = MulticlassAccuracy(6, average="micro")(prediction, truth)
    assert scores.means["accuracy"] == pytest.approx(float(overall))
    of_class = MulticlassAccuracy(6, average="none")(prediction, truth).numpy()
    np.testing.assert_allclose(scores.of_classes["accuracy"][:-1], of_class[:-1], rtol=1e-6)
    assert np.isnan(scores.of_classes["accuracy"][-1]), "absent, and left out of the mean"
    assert scores.means["class_accuracy"] == pytest.approx(float(of_class[:-1].mean()))
    assert scores.of_classes["images"].sum() == 38
