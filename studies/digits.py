"""Images of handwritten digits: MNIST where it is there, else the ones scikit-learn brings."""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError

__all__ = ["BODY", "SIDE", "Digits", "bundled_digits", "find_mnist", "read_idx", "read_mnist"]

SIDE = 28
"""Rows and columns of the images."""

BODY = 20
"""Rows and columns that MNIST's digits fill; the rest is a dark rim."""

_TEST = 597
"""Images of scikit-learn's that are tested on, the last ones."""

_BYTES = 0x08
_MOST_BYTES = 1 << 27  # MNIST has half of that; packed files can hold a thousand times as much
_EXPECTED = "MNIST as torchvision stores it: raw/train-images-idx3-ubyte and three more files"


@dataclass(frozen=True)
class Digits:
    """Images in [0, 1], bright on dark, and their classes.

    Attributes:
        name: Of the data set.
        train_images: ``(n, 28, 28)`` float32.
        train_labels: ``(n,)`` int64.
        test_images: ``(m, 28, 28)`` float32.
        test_labels: ``(m,)`` int64.
        epochs: That a small network takes to learn them.
    """

    name: str
    train_images: NDArray[np.float32]
    train_labels: NDArray[np.int64]
    test_images: NDArray[np.float32]
    test_labels: NDArray[np.int64]
    epochs: int


def bundled_digits() -> Digits:
    """The 1797 digits of scikit-learn, enlarged from 8² to 20² and framed as MNIST's are.

    The first 1200 are trained on, the last 597 tested on; they lie in the order of their writers.

    Raises:
        SettingError: scikit-learn is not installed.
    """
    try:
        from sklearn.datasets import load_digits
    except ImportError as error:
        raise SettingError(
            "distorted_digits",
            found="no scikit-learn",
            expected="the package that brings the digits, or mnist=<folder>",
            remedy="Run: pip install 'tangent-train[study]'",
        ) from error
    bunch = load_digits()
    small = (bunch.images / 16).astype(np.float32)
    rim = (SIDE - BODY) // 2
    large = [cv2.resize(image, (BODY, BODY), interpolation=cv2.INTER_CUBIC) for image in small]
    images = np.pad(np.clip(large, 0, 1), ((0, 0), (rim, rim), (rim, rim)))
    labels = bunch.target.astype(np.int64)
    train, test = slice(-_TEST), slice(-_TEST, None)
    name = "scikit-learn's digits"
    return Digits(name, images[train], labels[train], images[test], labels[test], epochs=30)


def read_mnist(folder: Path) -> Digits:
    """MNIST from its four files, packed with gzip or not.

    Args:
        folder: With the files, or with ``raw`` or ``MNIST/raw`` below it.

    Raises:
        DataError: A file is missing or broken.
    """
    parts: list[NDArray[Any]] = []
    for part, (of_images, of_labels) in find_mnist(folder).items():
        images, labels = read_idx(of_images, 3), read_idx(of_labels, 1)
        fit = images.shape[1:] == (SIDE, SIDE) and len(images) == len(labels) > 0
        if not fit or labels.max() > 9:
            raise DataError(
                folder,
                found=f"{part}: images of shape {images.shape}, {len(labels)} labels",
                expected=f"images of {SIDE}×{SIDE}, a label from 0 to 9 for each",
            )
        parts += [np.divide(images, 255, dtype=np.float32), labels.astype(np.int64)]
    train_images, train_labels, test_images, test_labels = parts
    return Digits("MNIST", train_images, train_labels, test_images, test_labels, epochs=2)


def find_mnist(folder: Path) -> dict[str, tuple[Path, Path]]:
    """MNIST's files of images and of labels, for training and for testing; see `read_mnist`.

    Raises:
        DataError: One is missing.
    """
    return {
        part: (
            _find(folder, f"{part}-images-idx3-ubyte"),
            _find(folder, f"{part}-labels-idx1-ubyte"),
        )
        for part in ("train", "t10k")
    }


def read_idx(path: Path, dimensions: int) -> NDArray[np.uint8]:
    """An array of bytes in MNIST's format: 0, 0, type, rank, sizes, values.

    Args:
        path: The file; with ``.gz`` at its end it is unpacked.
        dimensions: How many it has.

    Raises:
        DataError: It cannot be read, is of another type, or is cut off.
    """
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            content = file.read(_MOST_BYTES)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(path, found=repr(error), expected=_EXPECTED) from error
    start = 4 + 4 * dimensions
    if content[:4] != bytes((0, 0, _BYTES, dimensions)) or len(content) < start:
        raise DataError(path, found=f"a file that begins {content[:4]!r}", expected=_EXPECTED)
    shape = struct.unpack(f">{dimensions}I", content[4:start])
    if len(content) - start != math.prod(shape):
        raise DataError(
            path,
            found=f"{len(content) - start} values",
            expected=f"{' × '.join(map(str, shape))}, as its head says",
            remedy="The file is cut off or damaged; get it again.",
        )
    return np.frombuffer(content, np.uint8, offset=start).reshape(shape)


def _find(folder: Path, name: str) -> Path:
    # t10k-images.idx3-ubyte is how the files are called where they were unpacked by other programs.
    names = (name, f"{name}.gz", name.replace("-idx", ".idx"))
    for place in (folder, folder / "raw", folder / "MNIST" / "raw"):
        for candidate in names:
            if (place / candidate).is_file():
                return place / candidate
    raise DataError(folder, found=f"no {name}", expected=_EXPECTED)
