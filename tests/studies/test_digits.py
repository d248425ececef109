"""Readers of digits: MNIST's files in every layout and broken, scikit-learn's images."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import numpy as np
import pytest
from sklearn.datasets import load_digits

from studies.digits import bundled_digits, read_idx, read_mnist
from tangent_train.errors import DataError, SettingError
from tests.studies.mnist_format import idx, write_mnist


@pytest.mark.parametrize("place", [".", "raw", "MNIST/raw"])
@pytest.mark.parametrize("packed", [False, True])
def test_mnist_is_found_where_programs_leave_it(tmp_path: Path, place: str, packed: bool) -> None:
    content = write_mnist(tmp_path / "mnist" / place / ".", packed=packed)
    digits = read_mnist(tmp_path / "mnist")
    images = content["t10k-images-idx3-ubyte"]
    np.testing.assert_allclose(digits.test_images, images / 255, rtol=1e-6)
    np.testing.assert_array_equal(digits.train_labels, content["train-labels-idx1-ubyte"])
    assert (digits.train_images.dtype.name, digits.train_labels.dtype.name) == ("float32", "int64")
    assert (len(digits.train_images), len(digits.test_labels)) == (40, 20)


def test_names_with_a_dot_are_mnists_too(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist", style=".idx")
    assert len(read_mnist(tmp_path / "mnist").train_images) == 40


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist")
    (tmp_path / "mnist" / "t10k-labels-idx1-ubyte").unlink()
    with pytest.raises(DataError, match=r"mnist: found no t10k-labels-idx1-ubyte"):
        read_mnist(tmp_path / "mnist")


LABELS = np.arange(5, dtype=np.uint8)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", r"begins b''"),
        (b"\x00\x00\x08", r"begins"),
        (b"\x00\x00\x08\x01\x00", r"begins"),
        (idx(LABELS[None]), r"begins b'\\x00\\x00\\x08\\x02'"),
        (b"\x00\x00\x0d\x01" + idx(LABELS)[4:], r"begins"),
        (idx(LABELS)[:-1], r"found 4 values; expected 5, as its head says"),
        (idx(LABELS) + b"\0", r"found 6 values"),
        (b"\x00\x00\x08\x01\xff\xff\xff\xff", r"found 0 values; expected 4294967295"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "labels-idx1-ubyte"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        read_idx(path, 1)


# Without the time, which would be in the test's name.
PACKED = gzip.compress(idx(LABELS), mtime=0)


@pytest.mark.parametrize("content", [b"no gzip", PACKED[:-9], b""])
def test_broken_packing_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "labels-idx1-ubyte.gz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"ubyte\.gz: found"):
        read_idx(path, 1)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("train-labels-idx1-ubyte", np.zeros(39, np.uint8)),
        ("train-labels-idx1-ubyte", np.full(40, 10, np.uint8)),
        ("train-images-idx3-ubyte", np.zeros((40, 32, 32), np.uint8)),
    ],
)
def test_files_that_do_not_fit_are_refused(
    tmp_path: Path, name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
) -> None:
    write_mnist(tmp_path / "mnist")
    (tmp_path / "mnist" / name).write_bytes(idx(values))
    with pytest.raises(DataError, match=r"train: images of shape .*expected images of 28×28"):
        read_mnist(tmp_path / "mnist")


def test_no_images_at_all_are_refused(tmp_path: Path) -> None:
    write_mnist(tmp_path / "mnist", test=0)
    with pytest.raises(DataError, match=r"t10k: images of shape \(0, 28, 28\), 0 labels"):
        read_mnist(tmp_path / "mnist")


def test_the_bundled_digits_are_framed_as_mnists_are() -> None:
    digits, original = bundled_digits(), load_digits()
    assert digits.train_images.shape == (1200, 28, 28)
    assert digits.test_images.shape == (597, 28, 28)
    labels = np.concatenate([digits.train_labels, digits.test_labels])
    np.testing.assert_array_equal(labels, original.target)
    images = np.concatenate([digits.train_images, digits.test_images])
    assert images.dtype == np.float32
    assert (images.min(), images.max()) == (0, 1)
    rim = np.ones((28, 28), np.bool_)
    rim[4:24, 4:24] = False
    assert not images[:, rim].any()
    # As bright as they were: enlarging keeps the mean of each, to what clipping takes.
    before = original.images.mean(axis=(1, 2)) / 16
    np.testing.assert_allclose(images[:, 4:24, 4:24].mean(axis=(1, 2)), before, atol=0.03)


def test_without_scikit_learn_the_remedy_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.datasets", None)
    with pytest.raises(SettingError, match=r"pip install 'tangent-train\[study\]'"):
        bundled_digits()
