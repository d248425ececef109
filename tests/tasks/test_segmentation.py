from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import lightning
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

from tangent_train.errors import SettingError
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import SegmentationTask
from tests.tasks.shapes import quiet_trainer

NAMES = ("unknown", "a", "b")
SHAPE = (32, 64)


class Training(NamedTuple):
    images: Tensor
    labels: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class Evaluation(NamedTuple):
    images: Tensor
    target: Tensor
    rays: Tensor
    rotations: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class Data(lightning.LightningDataModule):
    """Panoramas whose class is the sign of the first channel."""

    def __init__(self, representation: TangentRepresentation, count: int = 3) -> None:
        super().__init__()
        rng = np.random.default_rng(0)
        coarse = rng.normal(size=(count, 2, 4, 8, 1)).astype(np.float32)
        panoramas = coarse.repeat(8, axis=2).repeat(8, axis=3)
        self.train, self.test = [], []
        for index, (signal, other) in enumerate(panoramas):
            truth = np.where(signal > 0, 2, 1).astype(np.uint8)[..., 0]
            truth[:2] = 0
            whole = representation.whole()
            images = np.concatenate([whole.render(x, "nearest") for x in (signal, other)], axis=-1)
            tensor = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()
            labels = torch.from_numpy(whole.render(truth, "nearest"))
            self.train.append(Training(tensor, labels, index))
            where = torch.tensor(whole.rays()), torch.tensor(whole.rotations())
            self.test.append(Evaluation(tensor, torch.from_numpy(truth), *where, index))

    def train_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.train, batch_size=2)  # type: ignore[arg-type]

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.test, batch_size=2)  # type: ignore[arg-type]

    test_dataloader = val_dataloader

    def class_weights(self, kind: str) -> Tensor:
        return {"none": torch.ones(3), "log": torch.tensor([0.0, 1.0, 3.0])}[kind]


class SignNetwork(nn.Module):
    """Scores that are right everywhere, the unknown class the highest."""

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        signal = images[:, :1]
        return {"out": torch.cat([signal.abs() + 1, -signal, signal], dim=1)}


@pytest.fixture(scope="module")
def representation() -> TangentRepresentation:
    return TangentRepresentation(base_level=0, level=4)


def _task(
    network: nn.Module, representation: TangentRepresentation, **settings: Any
) -> SegmentationTask:
    optimizer = partial(torch.optim.SGD, lr=0.1)
    return SegmentationTask(network, representation, NAMES, optimizer, **settings)


def test_evaluation_scores_every_panorama_against_its_own_labels(
    representation: TangentRepresentation,
) -> None:
    task = _task(SignNetwork(), representation, images_per_forward=7)
    trainer = quiet_trainer()
    (figures,) = trainer.test(task, datamodule=Data(representation), verbose=False)
    assert task.matrices.images == 3
    assert task.matrices.pixels[0].sum() == 0, "unknown truth counts for nothing"
    assert task.matrices.pixels[:, 0].sum() == 0, "unknown is never predicted"
    assert task.matrices.pixels.sum() == 3 * 30 * 64
    assert figures["test/miou"] > 0.75


def test_the_batch_of_spheres_gives_one_gradient(representation: TangentRepresentation) -> None:
    data = Data(representation, count=2)
    network = nn.Conv2d(2, 3, 1)
    task = _task(network, representation, class_weights=[0.0, 1.0, 3.0], label_smoothing=0.1)
    images = torch.cat([sample.images for sample in data.train])
    labels = torch.cat([sample.labels for sample in data.train]).long()
    loss = functional.cross_entropy(
        network(images), labels, torch.tensor([0.0, 1.0, 3.0]), ignore_index=0, label_smoothing=0.1
    )
    expected = torch.autograd.grad(loss, list(network.parameters()))
    before = [p.detach().clone() for p in network.parameters()]
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=data)
    for old, new, gradient in zip(before, network.parameters(), expected, strict=True):
        torch.testing.assert_close((old - new) / 0.1, gradient, rtol=1e-4, atol=1e-6)


def test_all_unknown_batches_leave_the_network_alone(
    representation: TangentRepresentation,
) -> None:
    data = Data(representation, count=2)
    for sample in data.train:
        sample.labels.zero_()
    network = nn.Conv2d(2, 3, 1)
    before = [p.detach().clone() for p in network.parameters()]
    quiet_trainer(max_steps=2, limit_val_batches=0).fit(
        _task(network, representation), datamodule=data
    )
    for old, new in zip(before, network.parameters(), strict=True):
        torch.testing.assert_close(old, new.detach())


def test_class_weights_come_from_the_data_or_the_settings(
    representation: TangentRepresentation,
) -> None:
    data = Data(representation)
    task = _task(nn.Conv2d(2, 3, 1), representation, class_weights="log")
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(task, datamodule=data)
    assert task.class_weights.tolist() == [0.0, 1.0, 3.0]
    given = _task(nn.Conv2d(2, 3, 1), representation, class_weights=[0.0, 2.0, 1.0])
    quiet_trainer(max_steps=1, limit_val_batches=0).fit(given, datamodule=data)
    assert given.class_weights.tolist() == [0.0, 2.0, 1.0]


def test_scores_that_do_not_fit_are_refused(representation: TangentRepresentation) -> None:
    task = _task(nn.Conv2d(2, 4, 1), representation)
    with pytest.raises(SettingError, match=r"scores of the network: found \(1, 4, 16, 16\)"):
        task(torch.zeros(1, 2, 16, 16))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("label_smoothing", 1.0),
        ("images_per_chunk", 0),
        ("images_per_forward", 0),
        ("absent_class", "drop"),
        ("auxiliary_weight", float("nan")),
        ("class_weights", "logg"),
        ("class_weights", [1.0, 2.0]),
    ],
)
def test_impossible_settings_are_refused(
    representation: TangentRepresentation, name: str, value: object
) -> None:
    with pytest.raises(SettingError, match=rf"task\.{name}"):
        _task(nn.Conv2d(2, 3, 1), representation, **{name: value})
