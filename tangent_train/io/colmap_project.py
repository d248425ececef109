"""COLMAP project: images, masks and the rig of a set of panoramas.

COLMAP assumes one camera per folder (``--ImageReader.single_camera_per_folder``), and that images
of one name in several folders were taken at the same time. So these folders have no subfolders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError
from tangent_train.geometry import PinholeGrid
from tangent_train.io.camera_files import RIG_FILE, write_rig
from tangent_train.io.pixel_files import write_pixels
from tangent_train.io.tangent_folders import face_name, shrink_to_level, write_each
from tangent_train.rendering import Interpolation, equirect_to_tangent


def flat_names(names: Sequence[str]) -> dict[str, str]:
    """Return file names without folders, by names of panoramas.

    Raises:
        DataError: Two names are the same.

    >>> flat_names(["x/1", "1"])
    {'x/1': 'x__1', '1': '1'}
    """
    flat = {name: name.replace("/", "__") for name in names}
    places: dict[str, str] = {}
    for name, short in flat.items():
        if places.setdefault(short.casefold(), name) != name:
            raise DataError(
                name,
                found=f"{places[short.casefold()]}, which is called {short} too",
                expected="panoramas whose paths differ with __ for /",
                remedy="Rename one of them.",
            )
    return flat


@dataclass(frozen=True)
class ColmapProject:
    """Project for COLMAP.

    Attributes:
        folder: Output folder.
        grid: Views of every panorama.
        level: Level s, see `shrink_to_level`.
        faces: Indices of the rendered images.
        suffix: Suffix of the image files.
        interpolation: See `equirect_to_tangent`.
    """

    folder: Path
    grid: PinholeGrid
    level: int
    faces: Sequence[int]
    suffix: str
    interpolation: Interpolation

    @property
    def _prefixes(self) -> dict[str, int]:
        """Faces by prefix of their images."""
        return {f"{face_name(self.grid, face)}/": face for face in self.faces}

    def write_images(
        self,
        name: str,
        image: NDArray[Any],
        counts: NDArray[np.uint8],
        progress: Callable[[float], object],
    ) -> None:
        """Render the images and masks of a panorama.

        Args:
            name: Name of the images, from `flat_names`.
            image: ``(H, W)`` or ``(H, W, C)``.
            counts: ``(H', W')``, 0 where pixels are ignored.
            progress: See `write_each`.

        Raises:
            SettingError: The files cannot hold its pixels.
        """
        if self.interpolation == "bilinear":
            image = shrink_to_level(image, self.level)

        def render(prefix: str, face: int) -> None:
            path = f"{prefix}{name}{self.suffix}"
            (pixels,) = equirect_to_tangent(image, self.grid, [face], self.interpolation)
            write_pixels(self.folder / "images" / path, pixels)
            (mask,) = equirect_to_tangent(counts, self.grid, [face], "nearest")
            write_pixels(self.folder / "masks" / f"{path}.png", mask)

        write_each(render, self._prefixes, progress)

    def write_rig(self, panoramas: Mapping[str, str]) -> None:
        """Write ``rig_config.json``.

        Args:
            panoramas: File of each panorama by the name of its images.
        """
        files = {f"{name}{self.suffix}": file for name, file in panoramas.items()}
        write_rig(self.folder / RIG_FILE, self.grid, self._prefixes, files)
