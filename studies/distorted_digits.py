"""How little distortion confuses a network (paper, figure "MNIST accuracy")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.digit_network import accuracy, train_classifier
from studies.digits import Digits, bundled_digits, read_mnist
from studies.lens import lens_images, mean_enlargement, zoom_images
from studies.outcome import Column, Outcome, canvas, parts, png, style
from tangent_train.results.reports.chart import COLORS

__all__ = ["K1", "distorted_digits"]

K1 = tuple(k / 20 for k in range(11))
"""The paper's range, 0 to 0.5."""

_COLUMNS = (
    Column("k1", "K1", ".2f"),
    Column("distorted_percent", "distorted", ".1f %"),
    Column("distorted_std", "±", ".1f"),
    Column("zoomed_percent", "zoomed", ".1f %"),
    Column("zoomed_std", "±", ".1f"),
    Column("enlargement", "enlargement", ".3f"),
)
_EXAMPLE = 11
_SHOWN = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)


def distorted_digits(
    mnist: Path | None,
    seeds: Sequence[int],
    epochs: int | None,
    say: Callable[[str], None],
) -> Outcome:
    """Accuracy of a classifier, trained on digits as they are, on distorted ones.

    Args:
        mnist: Folder of MNIST; scikit-learn's digits without.
        seeds: One network is trained for each.
        epochs: Of the training; without, what the data set takes.
        say: Is told what goes on.

    Raises:
        DataError: The folder has no MNIST.
        SettingError: scikit-learn is not installed.
    """
    digits = bundled_digits() if mnist is None else read_mnist(mnist)
    epochs = digits.epochs if epochs is None else epochs
    found = [_accuracies(digits, seed, epochs, say) for seed in seeds]
    lens, zoom = np.moveaxis(np.array(found), 1, 0)  # each (seeds, K1)
    rows = [_row(k, lens[:, at], zoom[:, at]) for at, k in enumerate(K1)]
    notes = (
        f"{digits.name}: {len(digits.train_labels)} images to train on, "
        f"{len(digits.test_labels)} to test on; {epochs} epochs; seeds "
        f"{', '.join(map(str, seeds))}. ± is the sample standard deviation over seeds.",
        "x′ = x (1 + K1 r²), half a side of the image being 1. Zoomed: enlarged evenly, as much as "
        "the lens does on average where digits are, to tell what is due to size alone.",
        "The paper names neither network nor training, and its figure is a picture without "
        "numbers.",
    )
    columns = (*_COLUMNS, *(Column(f"distorted_seed_{seed}") for seed in seeds))
    picture = _picture(digits, lens, zoom)
    return Outcome("Accuracy on distorted digits", columns, rows, notes, picture)


def _accuracies(
    digits: Digits, seed: int, epochs: int, say: Callable[[str], None]
) -> list[list[float]]:
    """``(2, K1)`` with the lens and zoomed."""
    say(f"seed {seed}: training on {len(digits.train_labels)} images, {epochs} epochs")
    network = train_classifier(digits.train_images, digits.train_labels, epochs, seed)
    return [
        [accuracy(network, change(digits.test_images, k), digits.test_labels) for k in K1]
        for change in (lens_images, zoom_images)
    ]


def _row(k1: float, lens: NDArray[np.float64], zoom: NDArray[np.float64]) -> list[Any]:
    summary = [part for values in (lens, zoom) for part in _mean_and_spread(100 * values)]
    return [k1, *summary, mean_enlargement(k1), *(100 * lens)]


def _mean_and_spread(values: NDArray[np.float64]) -> tuple[float, float | None]:
    return float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else None


def _picture(digits: Digits, lens: NDArray[np.float64], zoom: NDArray[np.float64]) -> bytes:
    figure = canvas(8.0, 6.2)
    above, below = parts(figure, (1, 2.8))
    above.suptitle("One of the test images", x=0.01, ha="left", fontsize=11)
    panels = above.subplots(1, len(_SHOWN))
    example = digits.test_images[_EXAMPLE % len(digits.test_images)][None]
    for axes, k in zip(panels, _SHOWN, strict=True):
        axes.imshow(lens_images(example, k)[0], cmap="gray", vmin=0, vmax=1)
        axes.set_title(f"K1 = {k}", fontsize=10)
        axes.set_axis_off()
    axes = below.subplots()
    for values, color, marker, name in (
        (lens, COLORS[0], "o", "distorted"),
        (zoom, COLORS[1], "s", "enlarged evenly, as much on average"),
    ):
        summary = [_mean_and_spread(100 * column) for column in values.T]
        spread = [part for _, part in summary] if len(values) > 1 else None
        means = [mean for mean, _ in summary]
        axes.errorbar(K1, means, spread, color=color, marker=marker, capsize=3, label=name)
    style(axes, f"Accuracy, {digits.name}", "K1", "%")
    axes.legend(frameon=False)
    return png(figure)
