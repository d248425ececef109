"""The readers that are given broken files."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tangent_train.errors import DataError
from tests.slow.fuzz import images, stores, texts
from tests.slow.fuzz.mutation import mutate, sealed_png

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from random import Random

    # A part of a file, and how to put another one in its place; None where there is none.
    Inner = Callable[[bytes], tuple[bytes, Callable[[bytes], bytes]] | None]

__all__ = ["LARGEST_IMAGE", "LONGEST_MESSAGE", "TARGETS", "Target"]

LARGEST_IMAGE = 1 << 22
"""Pixels, at most: all that take long to decode are refused, and memory is not used up by them."""

LONGEST_MESSAGE = 1000
"""Characters of an error, without the path: the file itself is not shown."""


@dataclass(frozen=True)
class Target:
    """A reader.

    Attributes:
        seeds: Makes valid files.
        read: Reads a file; what comes out wrong is an AssertionError.
        inner: A part that is broken by itself, the file around it made right again.
        sealed: Makes checksums right again.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], None]
    inner: Inner | None = None
    sealed: Callable[[bytes], bytes] | None = None

    def broken(self, content: bytes, rng: Random, others: list[bytes]) -> bytes:
        """A file with faults."""
        found = self.inner(content) if self.inner is not None and rng.random() < 0.6 else None
        if found is not None:
            part, put = found
            return put(mutate(part, rng, [part]))
        faulty = mutate(content, rng, others)
        return self.sealed(faulty) if self.sealed is not None and rng.random() < 0.7 else faulty

    def try_on(self, path: Path, content: bytes) -> str:
        """Read a file that holds `content`; only documented errors may come out.

        Returns:
            "read" or "refused".
        """
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.filterwarnings("ignore", module="PIL")  # broken EXIF data, and the like
                warnings.filterwarnings("ignore", "Reading `.npy`")  # as Python 2 wrote them
                self.read(path)
        except DataError as error:
            size = len(str(error).replace(str(path), ""))
            assert size <= LONGEST_MESSAGE, f"a message of {size} characters"
            return "refused"
        return "read"


TARGETS = {
    "label_table": Target(texts.table_seeds, texts.read_table),
    "classes": Target(texts.class_seeds, texts.read_class_list),
    "cameras": Target(texts.camera_seeds, texts.read_camera_list),
    "pose": Target(texts.pose_seeds, texts.read_pose),
    "off": Target(texts.off_seeds, texts.read_mesh),
    "label_image": Target(
        images.picture_seeds, images.read_picture, inner=images.scanlines, sealed=sealed_png
    ),
    "xmp": Target(images.xmp_seeds, images.read_xmp, inner=images.xmp_part),
    "pixels": Target(
        images.pixel_seeds, images.read_image, inner=stores.npy_part, sealed=sealed_png
    ),
    "store": Target(stores.store_seeds, stores.read_store, inner=stores.store_part),
    "spheres": Target(stores.sphere_seeds, stores.read_spheres, inner=stores.npy_part),
}
"""Of every name what is tried; files of any content may come."""
