"""Accuracy on distorted digits: ``python -m studies.distorted_digits [--mnist FOLDER]``.

Reproduces the paper's figure "MNIST accuracy": a classifier is trained on undistorted digits and
tested on digits with pincushion distortion x' = x (1 + K1 r²), in units of half the image's side.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from torch.nn import functional as F

from studies.output import Row, save
from tangent_train.results.chart import COLORS

K1 = [k / 20 for k in range(11)]
"""Coefficients of the distortion in the paper's range, 0 to 0.5."""

BODY = 20 / 28
"""Side of the square that contains MNIST's digits, relative to the image's side."""


class Digits(NamedTuple):
    """Images ``(n, 1, 28, 28)`` in [0, 1] and labels ``(n,)`` for training and test."""

    train_images: Tensor
    train_labels: Tensor
    test_images: Tensor
    test_labels: Tensor


def small_digits() -> Digits:
    """Return scikit-learn's 1797 digits, enlarged from 8² to 20² pixels, with MNIST's borders."""
    from sklearn.datasets import load_digits

    bunch = load_digits()
    images = torch.from_numpy(bunch.images[:, None] / 16).float()
    large = F.interpolate(images, (20, 20), mode="bicubic", align_corners=False).clamp(0, 1)
    images, labels = F.pad(large, (4, 4, 4, 4)), torch.from_numpy(bunch.target).long()
    return Digits(images[:1200], labels[:1200], images[1200:], labels[1200:])


def mnist(folder: str) -> Digits:
    """Read MNIST as torchvision stores it, ``<folder>/MNIST/raw``; nothing is downloaded."""
    from torchvision.datasets import MNIST

    train, test = MNIST(folder, train=True), MNIST(folder, train=False)
    images = [part.data[:, None] / 255 for part in (train, test)]
    return Digits(images[0], train.targets, images[1], test.targets)


def distort(images: Tensor, k1: float) -> Tensor:
    """Distort images ``(n, 1, s, s)`` with coefficient K1 ≥ 0; black beyond their edges."""
    points = pixel_centers(images)
    if k1 > 0:  # the real root of K1 r³ + r = r'
        q = (3 * k1) ** -0.5
        imaged = points.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        points = points * (2 * q * torch.sinh(torch.asinh(1.5 * imaged / q) / 3) / imaged)
    return sample(images, points)


def enlarge(images: Tensor, k1: float) -> Tensor:
    """Enlarge images by the average enlargement of the distortion in the digits' square."""
    return sample(images, pixel_centers(images) / mean_enlargement(k1))


def mean_enlargement(k1: float) -> float:
    """Return the mean of 1 + K1 r² over the square that contains the digits."""
    return 1 + k1 * 2 / 3 * BODY**2


def pixel_centers(images: Tensor) -> Tensor:
    """Return ``(1, s, s, 2)`` float64 positions, right and down; edges of the image are at ±1."""
    identity = torch.eye(2, 3, dtype=torch.float64)[None]
    return F.affine_grid(identity, [1, 1, *images.shape[2:]], align_corners=False)


def sample(images: Tensor, points: Tensor) -> Tensor:
    """Return bilinear samples of images at points; points beyond the edges are black."""
    grid = points.to(images.dtype).expand(len(images), -1, -1, -1)
    return F.grid_sample(images, grid, align_corners=False)


def normalized(images: Tensor) -> Tensor:
    """Normalize images by mean and standard deviation of MNIST's pixels."""
    return (images - 0.1307) / 0.3081


def train(images: Tensor, labels: Tensor, epochs: int, seed: int) -> nn.Module:
    """Train a network of two convolutions and 206,922 parameters, without augmentation."""
    torch.manual_seed(seed)
    network = nn.Sequential(
        *(nn.Conv2d(1, 16, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)),
        *(nn.Conv2d(16, 32, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)),
        *(nn.Flatten(), nn.Linear(32 * 7 * 7, 128), nn.ReLU(), nn.Linear(128, 10)),
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    steps = epochs * -(-len(images) // 64)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(epochs):
        for batch in torch.split(torch.randperm(len(images)), 64):
            optimizer.zero_grad()
            torch.autograd.backward(F.cross_entropy(network(images[batch]), labels[batch]))
            optimizer.step()
            schedule.step()
    return network.eval()


def distorted_digits(digits: Digits, epochs: int, seeds: Sequence[int]) -> list[Row]:
    """Return accuracy in percent: mean and sample standard deviation over the seeds."""
    images = normalized(digits.train_images)
    networks = [train(images, digits.train_labels, epochs, seed) for seed in seeds]
    rows: list[Row] = []
    for k1 in K1:
        row: Row = {"K1": k1, "enlargement": mean_enlargement(k1)}
        for name, change in (("distorted", distort), ("enlarged", enlarge)):
            images = normalized(change(digits.test_images, k1))
            with torch.inference_mode():
                right = [network(images).argmax(1) == digits.test_labels for network in networks]
            percent = [100 * float(one.double().mean()) for one in right]
            row |= {name: float(np.mean(percent)), f"{name} ±": float(np.std(percent, ddof=1))}
        rows.append(row)
    return rows


def picture(rows: Sequence[Row], digit: Tensor) -> Figure:
    """Plot a digit ``(1, 1, 28, 28)`` with several distortions, and the accuracies."""
    figure = Figure((8, 6.2), layout="constrained")
    above, below = np.array(figure.subfigures(2, 1, height_ratios=(1, 2.8)))
    for axes, k1 in zip(above.subplots(1, 6), K1[::2], strict=True):
        axes.imshow(distort(digit, k1)[0, 0], cmap="gray")
        axes.set(title=f"K1 = {k1}", xticks=[], yticks=[])
    axes = below.subplots()
    for name, color in zip(("distorted", "enlarged"), COLORS, strict=False):
        means, spread = [row[name] for row in rows], [row[f"{name} ±"] for row in rows]
        axes.errorbar(K1, means, spread, color=color, marker="o", capsize=3, label=name)
    axes.set(title="Accuracy", xlabel="K1", ylabel="%")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mnist", metavar="FOLDER", help="instead of scikit-learn's digits")
    folder = parser.parse_args().mnist
    found = mnist(folder) if folder else small_digits()
    table = distorted_digits(found, 2 if folder else 30, seeds=(0, 1, 2))
    save("distorted_digits", table, picture(table, found.test_images[11:12]), digits=3)
