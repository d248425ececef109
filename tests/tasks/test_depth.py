"""Depth: what is minimized, what is compared, and with what."""

from __future__ import annotations

from functools import partial
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import default_collate

from datamodules.core.dataset import Sample
from tangent_train.errors import SettingError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.heads.alignment import from_distance, is_metric
from tangent_train.kinds import DepthKind
from tangent_train.metrics.depth import depth_scores
from tangent_train.metrics.image_sums import means_of_sums
from tangent_train.rendering import PerspectiveRepresentation, TangentRepresentation
from tangent_train.results.evaluation import evaluation_result, result_tables
from tests.tasks.builders import depth_task
from tests.tasks.shapes import Spheres, gradients_of, quiet_trainer

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")

TANGENT = TangentRepresentation(base_level=0, level=4)
KINDS = [kind for kind in get_args(DepthKind) if kind != "relative_points"]


def _views(steps: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Views of a panorama: the logarithms of true distances and noise, labels, ray lengths."""
    (whole,) = TANGENT.view_sets()
    labels = torch.from_numpy(whole.render(steps, "nearest").astype(np.int32))
    shown = (labels.clamp(min=1) / 512).log()
    noise = torch.randn(labels.shape, generator=torch.Generator().manual_seed(int(labels.sum())))
    return torch.stack([shown, noise], dim=1), labels, torch.from_numpy(whole.ray_lengths())


class Data(Spheres):
    """Panoramas whose first channel is the logarithm of the distance; some distances are unknown.

    In training the distances of the second panorama are unknown.
    """

    def __init__(self, batch_size: int = 3) -> None:
        super().__init__(batch_size)
        rng = np.random.default_rng(0)
        coarse = rng.uniform(500, 3000, (3, 4, 8)).astype(np.uint16)
        for steps in coarse.repeat(8, axis=1).repeat(8, axis=2):
            images, labels, lengths = _views(steps)
            steps[:3] = 0
            labels[:7, 1:] = 0
            labels *= len(self.train) != 1
            self.train.append(Sample(images, labels, lengths, 0))
            self.test.append(Sample(images, torch.from_numpy(steps.astype(np.int32)), lengths, 0))


class Right(nn.Module):
    """Returns the true depth of a kind, of the views of tangent images or the given crops.

    A relative network gives each view, which it recognizes by its noise, another scale and shift.
    """

    def __init__(self, kind: DepthKind, lengths: Any = None) -> None:
        super().__init__()
        self.kind: DepthKind = kind
        whole = TANGENT.view_sets()[0]
        self.lengths = torch.from_numpy(whole.ray_lengths()) if lengths is None else lengths

    def forward(self, images: Tensor) -> Tensor:
        depth = from_distance(images[:, :1].exp(), self.kind, self.lengths[:, None])
        if is_metric(self.kind):
            return depth
        scale, shift = (images[:, 1, k, 0].exp()[:, None, None, None] for k in (0, 1))
        return scale * depth + shift * (self.kind != "relative_z")


def _task(network: nn.Module, representation: Any = TANGENT, **settings: Any) -> Any:
    kind: Any = settings.setdefault("depth_kind", getattr(network, "kind", "log_distance"))
    settings = {"alignment": "none" if is_metric(kind) else "affine"} | settings
    optimizer = settings.pop("optimizer", partial(torch.optim.SGD, lr=0.1))
    return depth_task(network, representation, optimizer, **settings)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_output_becomes_the_true_distance(kind: DepthKind) -> None:
    """Within the limits, in training and evaluation; unknown truth counts for nothing."""
    task, data = _task(Right(kind), eval_view_batch_size=7, max_distance=5.0), Data()
    (batch,) = data.train_dataloader()
    images, truth = task.training_pairs(batch)
    near = (batch.labels > 0) & (batch.labels <= 5 * 512)
    assert task.head.loss_norm(truth).item() == int(near.sum())
    assert task.loss_sum(task(images), truth) / near.sum() == pytest.approx(0, abs=2e-5)
    (scores,) = quiet_trainer().validate(task, datamodule=data, verbose=False)
    assert scores["val/loss"] == pytest.approx(0, abs=2e-5)
    counts = [int(((s.labels > 0) & (s.labels <= 5 * 512)).sum()) for s in data.test]
    assert task.result[:, 0, 0].tolist() == counts
    assert task.head.facts["range"] == "0 to 5 m"
    # Pixels at the borders of the blocks are interpolated.
    assert scores["val/absrel"] < 0.09
    assert scores["val/delta1"] > 0.9
    assert scores["val/missing"] == 0
    record = evaluation_result(task.head, task.result, "panoramas", 3)
    assert next(band["latitude_deg"] for band in record.latitude_bands) == [60, 90]
    defined = {name for name in task.head.columns if not name.startswith("consistency")}
    assert (
        record.intervals.keys() == defined == {n for n, s in record.scores.items() if s is not None}
    )
    with_unknown = np.concatenate([task.result, np.zeros_like(task.result[:1])])
    sums = task.head.image_sums(with_unknown)
    assert means_of_sums(sums, places=[1])["mae"] == depth_scores(task.result[1, 0])["mae"]
    assert means_of_sums(sums, places=[3]).keys() == defined
    if is_metric(kind):
        images[:, 0] += np.log(1.1)
        loss = task.loss_sum(task(images), truth) / near.sum()
        assert loss.item() == pytest.approx(np.log(1.1), rel=1e-4), "10 % too far"


@pytest.mark.parametrize("kind", KINDS)
def test_crops_of_a_photo_have_the_ray_lengths_of_the_photo_and_scales_of_their_own(
    kind: DepthKind,
) -> None:
    representation = PerspectiveRepresentation(5, dim=16)
    steps = np.random.default_rng(0).uniform(500, 3000, (6, 10)).astype(np.uint16)
    steps = steps.repeat(8, axis=0).repeat(8, axis=1)
    camera = camera_matrix_from_fov(80.0, steps.shape)
    (crops,) = representation.of_camera(camera, steps.shape).view_sets()
    target = torch.from_numpy(crops.render(steps, "nearest").astype(np.int32))
    shown = (target / 512).log()
    images = torch.stack([shown, torch.randn(shown.shape)], dim=1)
    lengths = torch.from_numpy(crops.ray_lengths())
    assert len(crops) > 1
    assert lengths.amax() > 1.2
    batch = default_collate([Sample(images, target, lengths, 0)])
    task = _task(Right(kind, lengths), representation)
    torch.testing.assert_close(task.evaluate(batch)[0], target / 512, rtol=1e-3, atol=0)
    result = task.metric.compute()
    assert task.head.scores(result).means["absrel"] < 1e-3
    assert "views_aligned" not in task.head.facts
    (table,) = result_tables(evaluation_result(task.head, result, "photos", 1))
    assert not any("solid angle" in name for name, _ in table.rows)


def test_views_are_aligned_with_each_other_as_set() -> None:
    """A network of the right distances, but for a scale of each view."""

    class Scaled(nn.Module):
        def forward(self, images: Tensor) -> Tensor:
            return images[:, :1] + 0.5 * images[:, 1:, :1, :1]

    errors = {}
    for align in (None, "scale", "none"):
        task = _task(Scaled(), align=align, alignment="median")
        assert "views_aligned" not in task.head.facts
        (scores,) = quiet_trainer().test(task, datamodule=Data(), verbose=False)
        errors[align] = scores["test/absrel"]
        assert task.head.facts["views_aligned"] == (align or "scale")
    assert errors[None] == errors["scale"] < 0.1 < 0.2 < errors["none"]


def _network() -> nn.Module:
    torch.manual_seed(0)
    last = nn.Conv2d(8, 1, 3, padding=1)
    nn.init.constant_(last.bias, 1)  # type: ignore[arg-type]  # positive
    return nn.Sequential(nn.Conv2d(2, 8, 3, padding=1), nn.ReLU(), last)


@pytest.mark.parametrize(
    ("loss", "kind"),
    [
        *(("log_l1", "metric_z"), ("log_l1", "relative_disparity")),
        *(("scale_invariant", "log_distance"), ("scale_invariant", "relative_disparity")),
    ],
)
def test_chunks_and_accumulated_batches_give_the_gradient_of_one_mean(
    loss: Any, kind: DepthKind
) -> None:
    settings = {"loss": loss, "depth_kind": kind, "alignment": "affine"}
    network, task = _network(), _task(nn.Identity(), **settings)
    images, truth = task.training_pairs(next(iter(Data().train_dataloader())))
    errors = task.head.errors(network(images), truth)
    known = ~errors.isnan()
    if loss == "log_l1":
        mean = errors[known].abs().mean()
    else:
        of_images = [e[~e.isnan()] for e in errors if not e.isnan().all()]
        sums = [e.square().sum() - 0.5 * e.sum() ** 2 / len(e) for e in of_images]
        mean = torch.stack(sums).sum() / known.sum()
    expected = torch.autograd.grad(mean, list(network.parameters()))
    whole = torch.cat([part.flatten() for part in expected])
    for size, batch_size in ((None, 3), (7, 3), (7, 1)):
        trained = _task(_network(), view_batch_size=size, **settings)
        kept = gradients_of(trained, Data(batch_size), accumulate_grad_batches=3 // batch_size)
        found = torch.cat([gradient.flatten() for gradient in kept.found])
        assert float((found - whole).norm() / whole.norm()) < 1e-4


def test_relative_depth_is_not_compared_without_an_alignment() -> None:
    with pytest.raises(SettingError, match=r"task.head.alignment.*relative_depth"):
        _task(Right("relative_depth"), alignment="none")
