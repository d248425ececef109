"""The classifier of digits: the same for a seed, and nothing outside it moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from studies.digit_network import accuracy, train_classifier
from studies.digits import read_mnist
from tests.studies.mnist_format import write_mnist


class Brightest(torch.nn.Module):
    """Names the brightest of the first ten pixels in the upper row."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images[:, 0, 0, :10]


def test_accuracy_is_the_share_that_is_right() -> None:
    images = np.zeros((1003, 28, 28), np.float32)
    labels = np.arange(1003) % 10
    images[np.arange(1003), 0, labels] = 1
    labels[::4] = (labels[::4] + 1) % 10
    assert accuracy(Brightest(), images, labels) == 1 - 251 / 1003


def test_a_seed_makes_one_network_and_leaves_torch_alone(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist")
    digits = read_mnist(tmp_path / "mnist")
    torch.manual_seed(11)
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    first, again, other = (
        train_classifier(digits.train_images, digits.train_labels, 2, seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_num_threads() == threads
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["0.weight"], other["0.weight"])
    assert sum(tensor.numel() for tensor in first.values()) == 206_922


def test_it_learns_what_is_plain_to_see(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist", train=400)
    digits = read_mnist(tmp_path / "mnist")
    network = train_classifier(digits.train_images, digits.train_labels, 12, 0)
    assert not network.training
    assert accuracy(network, digits.test_images, digits.test_labels) > 0.9
