"""Segmentation: what is minimized, and what is scored."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from datamodules.core.dataset import Sample
from models import AuxiliaryHead
from tangent_train.errors import SettingError
from tangent_train.heads import ClassesHead
from tangent_train.metrics.image_sums import drawn_scores, intervals
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import PixelTask
from tests.tasks.builders import segmentation_task
from tests.tasks.shapes import Spheres, quiet_trainer

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`:UserWarning")

NAMES = ("unknown", "a", "b")
WEIGHTS = torch.tensor([1.0, 3.0])
ONE = torch.ones(1, 1, 1)
TANGENT = TangentRepresentation(base_level=0, level=4)


def _sample(images: Tensor, target: Tensor) -> Any:
    return Sample(images, target, ONE, 0)


class Data(Spheres):
    """Panoramas whose class is the sign of the first channel.

    In training the second one is unknown, and of the first images of the others nearly all.
    """

    def __init__(self, count: int = 3, batch_size: int = 2) -> None:
        super().__init__(batch_size)
        rng = np.random.default_rng(0)
        coarse = rng.normal(size=(count, 2, 4, 8, 1)).astype(np.float32)
        panoramas = coarse.repeat(8, axis=2).repeat(8, axis=3)
        for signal, other in panoramas:
            truth = np.where(signal > 0, 2, 1).astype(np.uint8)[..., 0]
            truth[:2] = 0
            (whole,) = TANGENT.view_sets()
            images = np.concatenate([whole.render(x, "nearest") for x in (signal, other)], axis=-1)
            tensor = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()
            labels = torch.from_numpy(whole.render(truth, "nearest"))
            labels[:7, 1:] = 0
            labels *= len(self.train) != 1
            self.train.append(Sample(tensor, labels, ONE, 0))
            self.test.append(_sample(tensor, torch.from_numpy(truth)))

    def class_weights(self, kind: str) -> Tensor:
        return {"none": torch.ones(2), "log": WEIGHTS}[kind]


class SignNetwork(nn.Module):
    """Scores that are right everywhere."""

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        signal = images[:, :1]
        return {"out": torch.cat([-signal, signal], dim=1)}


def _task(network: nn.Module, **settings: Any) -> Any:
    optimizer = partial(torch.optim.SGD, lr=0.1)
    return segmentation_task(network, TANGENT, NAMES, optimizer, **settings)


def test_evaluation_scores_every_panorama_against_its_own_labels() -> None:
    task = _task(SignNetwork(), eval_view_batch_size=7)
    trainer = quiet_trainer()
    (figures,) = trainer.test(task, datamodule=Data(), verbose=False)
    assert task.evaluated == 3
    assert task.result.pixels[0].sum() == 0, "unknown truth counts for nothing"
    assert task.result.pixels[:, 0].sum() == 0, "unknown is never predicted"
    assert task.result.pixels.sum() == 3 * 30 * 64
    assert figures["test/miou"] > 0.75


def test_class_weights_come_from_the_data_or_the_settings() -> None:
    data = Data()
    task = _task(nn.Conv2d(2, 2, 1), class_weights="log")
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=data)
    assert task.head.class_weights.tolist() == [1.0, 3.0]
    given = _task(nn.Conv2d(2, 2, 1), class_weights=[2.0, 1.0])
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(given, datamodule=data)
    assert given.head.class_weights.tolist() == [2.0, 1.0]


@pytest.mark.parametrize("weight", [0.0, 0.4])
def test_the_auxiliary_head_adds_its_loss(weight: float) -> None:
    images, labels = torch.randn(6, 2, 16, 16), torch.randint(0, 3, (6, 16, 16)).byte()
    network = AuxiliaryHead(nn.Sequential(nn.Conv2d(2, 2, 1)), "0", 2, 2)
    task = _task(network, auxiliary_weight=weight)
    task.head.class_weights.copy_(WEIGHTS)
    found = task.loss_sum(task(images), labels) / task.head.loss_norm(labels)
    known = labels > 0
    main, auxiliary = (
        functional.cross_entropy(scores.movedim(1, -1)[known], labels[known].long() - 1, WEIGHTS)
        for scores in network(images).values()
    )
    torch.testing.assert_close(found, main + weight * auxiliary)


class Confidence(PixelTask):
    """A loss of the user, of a further output of the network; 10 of every pixel."""

    def loss_sum(self, outputs: Any, targets: Tensor) -> Tensor:
        return 10 * outputs["further"][(targets > 0)[:, None]].sum()


class Further(nn.Module):
    """Returns a second output beside the scores, and an auxiliary one in evaluation too."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(2, 2, 1)

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        scores = self.layer(images)
        ones = torch.ones_like(scores[:, :1]) + 0 * scores[:, :1]
        return {"out": scores, "aux": scores + 1e3, "further": ones}


class ConstantHead(ClassesHead):
    """A loss of the user: 7 of every labeled pixel."""

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        return 7 * (targets > 0).sum() + 0 * outputs.sum()


@pytest.mark.parametrize(
    ("kind", "head", "expected"), [(Confidence, ClassesHead, 10), (PixelTask, ConstantHead, 7)]
)
def test_a_loss_of_the_user_is_that_of_training_and_validation(
    kind: Any, head: Any, expected: float
) -> None:
    task = kind(Further(), TANGENT, head(NAMES), partial(torch.optim.SGD, lr=0.1))
    task.auxiliary_weight = 0
    trainer = quiet_trainer(max_epochs=1)
    trainer.fit(task, datamodule=Data())
    assert trainer.callback_metrics["val/loss"] == pytest.approx(expected)
    assert trainer.callback_metrics["train/loss"] == pytest.approx(expected)


def test_the_validation_loss_is_that_of_the_main_output() -> None:
    task = _task(Further())
    trainer = quiet_trainer(max_epochs=1, limit_train_batches=0)
    (scores,) = trainer.validate(task, datamodule=Data(), verbose=False)
    task.auxiliary_weight = 1e6
    assert trainer.validate(task, datamodule=Data(), verbose=False) == [scores]


def test_intervals_count_absent_classes_as_the_score_does() -> None:
    """Of two classes the first is right everywhere, and the second is absent."""
    for absent, expected in (("skip", 1.0), ("zero", 0.5)):
        head = ClassesHead(NAMES, absent_class=absent)  # type: ignore[arg-type]
        metric = head.build_metric()
        for _ in range(3):
            metric.update(torch.ones(4, 8, dtype=torch.long), torch.ones(4, 8, dtype=torch.long))
        result = metric.compute()
        assert head.scores(result).means["miou"] == expected
        found = intervals(drawn_scores(head.image_sums(result), absent))["miou"]
        assert found == pytest.approx((expected, expected))


def test_scores_that_do_not_fit_are_refused() -> None:
    task = _task(nn.Conv2d(2, 3, 1))  # as if unknown were a class
    received = r"output of the network: found \(1, 3, 16, 16\); expected \(1, 2, 16, 16\)"
    with pytest.raises(SettingError, match=received):
        task(torch.zeros(1, 2, 16, 16))
