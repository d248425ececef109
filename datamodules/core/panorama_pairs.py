"""Pairs of panoramas of the same place, with depth and pose if known."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import combinations, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datamodules.core.data_module import print_on_rank_zero
from datamodules.core.files import ImageFiles
from tangent_train.errors import SettingError
from tangent_train.geometry import PanoramaPose
from tangent_train.io.gpano import (
    PanoramaArea,
    check_resolution,
    read_area,
    read_tags,
    refuse_stereo,
)
from tangent_train.io.image_files import image_paths, short_names
from tangent_train.io.pixel_files import read_rgb
from tangent_train.rendering.resampling import resize


class PairedPanorama(NamedTuple):
    """One panorama of a pair.

    Attributes:
        name: Unique name; a panorama has the same name in every pair.
        rgb: ``(H, W, 3)`` uint8.
        distance_m: ``(H, W)`` float32 meters from the center, NaN where missing; or None.
        pose: Camera pose; or None.
        valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
    """

    name: str
    rgb: NDArray[np.uint8]
    distance_m: NDArray[np.float32] | None = None
    pose: PanoramaPose | None = None
    valid: NDArray[np.bool_] | None = None


class PanoramaPair(NamedTuple):
    """Two panoramas that show the same place.

    Attributes:
        name: Unique among the pairs.
        split: Split of the pair, if given.
        left: First panorama.
        right: Second panorama.
    """

    name: str
    split: str | None
    left: PairedPanorama
    right: PairedPanorama


class PublishedPair(NamedTuple):
    """A pair of the paper with its published scores.

    Attributes:
        number: 0 to 59.
        split: ``easy`` or ``hard``.
        left: Abbreviated camera and room of the first panorama, e.g. ``0f65e09_hallway_7``.
        right: Abbreviated camera and room of the second panorama.
        fov_overlap: Overlap of the fields of view, 0 to 1.
        scores: PMR, MS and P from 0 to 1, by representation: ``ERP``, ``L0``, ``L1``, ``L2``.
    """

    number: int
    split: str
    left: str
    right: str
    fov_overlap: float
    scores: dict[str, tuple[float, ...]]


class PanoramaPairs(ABC):
    """Pairs of panoramas, read one at a time.

    Attributes:
        published: The paper's scores by name of the pair, for the paper's pairs.
        pairs: Unique name of each pair, and the files of its two panoramas, with their image `rgb`.
    """

    published: Mapping[str, PublishedPair] = MappingProxyType({})
    pairs: Any

    def make_files(self) -> None:  # noqa: B027, most have all their files
        """Generate missing files; called before anything else."""

    @abstractmethod
    def panorama(self, files: Any) -> PairedPanorama:
        """Read a panorama of `pairs`.

        Raises:
            DataError: A file cannot be used.
        """

    @property
    def names(self) -> list[str]:
        """Names of the pairs, in order.

        Raises:
            SettingError: There are no pairs.
        """
        if not self.pairs:
            found, expected = "no two panoramas of one room", "a data set of pairs"
            raise SettingError("data", found=found, expected=expected)
        return [name for name, _, _ in self.pairs]

    def read(self, index: int) -> PanoramaPair:
        """Read a pair.

        Raises:
            DataError: A file cannot be used.
        """
        name, left, right = self.pairs[index]
        split = self.published[name].split if name in self.published else None
        return PanoramaPair(name, split, self.panorama(left), self.panorama(right))


def read_whole(path: Path, erp_height: int | None) -> NDArray[np.uint8]:
    """Read the image of a whole panorama, downsampled to `erp_height` rows unless it is None.

    Raises:
        DataError: The image is not a panorama.
        SettingError: The image has fewer rows than `erp_height`.
    """
    rgb = read_rgb(path)
    size = rgb.shape[0], rgb.shape[1]
    check_resolution(path, size, PanoramaArea.on_canvas(None, erp_height or 1), None)
    return rgb if erp_height is None else resize(rgb, (erp_height, 2 * erp_height), "bilinear")


class ImagePairs(PanoramaPairs):
    """Pairs of panoramas that are image files, without depth and pose.

    Args:
        left: First panorama; requires `right`.
        right: Second panorama.
        input: Folder of panoramas, or a pattern, instead of `left` and `right`; see `image_paths`.
        pairing: Pairs of `input`: `consecutive` (each panorama with the next in the order of the
            paths) or `all` (every combination).

    Raises:
        SettingError: The settings exclude each other, or there are not two panoramas.
    """

    def __init__(
        self,
        left: str | None = None,
        right: str | None = None,
        input: str | None = None,  # noqa: A002, the name of the setting
        pairing: Literal["consecutive", "all"] = "consecutive",
    ) -> None:
        given = [path for path in (left, right, input) if path is not None]
        paths = [path for one in given for path in image_paths(one, tell=print_on_rank_zero)]
        if len(given) != (1 if input else 2) or len(paths) < 2 or (left and len(paths) > 2):
            expected = "left=<panorama> right=<panorama>, or input=<folder of panoramas>"
            found = f"{' '.join(map(str, given))}: {len(paths)} panoramas"
            raise SettingError("input", found=found, expected=expected)
        images = map(ImageFiles, short_names(paths), paths)
        chosen = pairwise(images) if pairing == "consecutive" else combinations(images, 2)
        self.pairs = [(f"{one.name} – {other.name}", one, other) for one, other in chosen]

    def panorama(self, files: ImageFiles) -> PairedPanorama:
        """See `PanoramaPairs`; a partial panorama repeats its edges elsewhere."""
        rgb = read_rgb(files.rgb)
        refuse_stereo(files.rgb, read_tags(files.rgb))
        area = read_area(files.rgb, (rgb.shape[0], rgb.shape[1]))
        whole = area.filled(area.place(rgb), "edge")
        return PairedPanorama(files.name, whole, valid=area.valid)
