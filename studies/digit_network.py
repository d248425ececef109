"""A small classifier of digits: two convolutions, trained in seconds on one core."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from studies.digits import SIDE

__all__ = ["accuracy", "train_classifier"]

_BATCH = 64
_RATE = 1e-3
_MEAN, _STD = 0.1307, 0.3081
"""Of MNIST's pixels, as is usual."""


def train_classifier(
    images: NDArray[np.float32], labels: NDArray[np.int64], epochs: int, seed: int
) -> nn.Module:
    """Train on images as they are: no augmentation, which would hide what is studied.

    One thread, so that a seed gives the same network however many there are.

    Args:
        images: ``(n, 28, 28)`` in [0, 1].
        labels: ``(n,)`` 0 to 9.
        epochs: Passes over the images.
        seed: Of the weights and the order of the images.

    Returns:
        The network, ready to be evaluated.
    """
    inputs, classes = _tensor(images), torch.from_numpy(labels)
    with _one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network()
        optimizer = torch.optim.Adam(network.parameters(), lr=_RATE)
        steps = epochs * -(-len(inputs) // _BATCH)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(epochs):
            for batch in torch.split(torch.randperm(len(inputs)), _BATCH):
                optimizer.zero_grad()
                loss = nn.functional.cross_entropy(network(inputs[batch]), classes[batch])
                torch.autograd.backward(loss)
                optimizer.step()
                schedule.step()
    return network.eval()


def accuracy(network: nn.Module, images: NDArray[np.float32], labels: NDArray[np.int64]) -> float:
    """Share of images whose class is found.

    Args:
        network: From `train_classifier`.
        images: ``(m, 28, 28)`` in [0, 1].
        labels: ``(m,)``.
    """
    with _one_thread(), torch.inference_mode():
        parts = [network(part).argmax(dim=1) for part in torch.split(_tensor(images), 1000)]
    return float((torch.cat(parts).numpy() == labels).mean())


def _network() -> nn.Sequential:
    """206,922 parameters."""
    quarter = SIDE // 4
    return nn.Sequential(
        nn.Conv2d(1, 16, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Conv2d(16, 32, 3, padding=1),
        nn.ReLU(),
        nn.MaxPool2d(2),
        nn.Flatten(),
        nn.Linear(32 * quarter**2, 128),
        nn.ReLU(),
        nn.Linear(128, 10),
    )


def _tensor(images: NDArray[np.float32]) -> Tensor:
    return ((torch.from_numpy(images) - _MEAN) / _STD)[:, None]


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
