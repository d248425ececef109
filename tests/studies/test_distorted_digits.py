"""The study of distorted digits on a small MNIST."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from studies.digit_network import accuracy, train_classifier
from studies.digits import read_mnist
from studies.distorted_digits import K1, distorted_digits
from studies.lens import lens_images, mean_enlargement
from tests.studies.mnist_format import write_mnist


def test_each_row_is_the_accuracy_of_all_networks(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist", train=200, test=50)
    said: list[str] = []
    found = distorted_digits(tmp_path / "mnist", [0, 5], 3, said.append)
    assert said == [f"seed {seed}: training on 200 images, 3 epochs" for seed in (0, 5)]
    digits = read_mnist(tmp_path / "mnist")
    networks = [
        train_classifier(digits.train_images, digits.train_labels, 3, seed) for seed in (0, 5)
    ]
    names = [column.key for column in found.columns]
    assert [row[0] for row in found.rows] == list(K1) == pytest.approx(np.linspace(0, 0.5, 11))
    for row in (found.rows[0], found.rows[7]):
        values = dict(zip(names, row, strict=True))
        images = lens_images(digits.test_images, values["k1"])
        expected = [100 * accuracy(network, images, digits.test_labels) for network in networks]
        assert [values[f"distorted_seed_{seed}"] for seed in (0, 5)] == pytest.approx(expected)
        assert values["distorted_percent"] == pytest.approx(np.mean(expected))
        assert values["distorted_std"] == pytest.approx(np.std(expected, ddof=1))
        assert values["enlargement"] == mean_enlargement(values["k1"])
    # Nothing done is the same both ways; bars moved to where another class has them are not.
    first, last = (dict(zip(names, found.rows[k], strict=True)) for k in (0, -1))
    assert first["distorted_percent"] == first["zoomed_percent"]
    assert last["distorted_percent"] < first["distorted_percent"]


def test_one_seed_has_no_spread(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist")
    found = distorted_digits(tmp_path / "mnist", [3], None, lambda _: None)
    assert found.rows[0][2] is None
    assert found.cells()[1][2] == "–"
    assert "MNIST: 40 images to train on, 20 to test on; 2 epochs; seeds 3." in found.notes[0]
