"""A user's own photos, of any size and camera, in the tree of `labelled`.

Besides it, ``root/cameras.json`` may hold their camera matrices, see `read_cameras`. Depth is
z-depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.core.photo_module import PhotoDataModule
from datamodules.folder.cameras import FolderCameras, read_cameras
from datamodules.folder.labelled import LabelledFolder
from datamodules.folder.reader import FolderReader
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from datamodules.core.problems import Problems
    from datamodules.core.reading import ImageFiles

__all__ = ["FolderPhotos"]


@dataclass(frozen=True)
class _PhotoReader(FolderReader):
    """Reads a user's own photos."""

    cameras: FolderCameras

    @property
    def settings(self) -> dict[str, str]:
        """The cameras in short too: they are stored with the photos."""
        return {**super().settings, "cameras": self.cameras.fingerprint}

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """The camera matrix, by ``cameras.json``, the field of view or the EXIF data."""
        return self.cameras.matrix(files)


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class FolderPhotos(LabelledFolder, PhotoDataModule):
    """A user's own photos, with the classes of ``classes.json``.

    Args:
        fov: Horizontal field of view, in degrees, of all photos that ``cameras.json`` does not
            name; None for that of their EXIF data.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting is invalid.
    """

    fov: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fov is not None and not 0 < self.fov < 180:
            raise SettingError(
                "data.fov", found=self.fov, expected="degrees, more than 0 and less than 180"
            )

    def make_reader(self, images: Sequence[ImageFiles], problems: Problems) -> FolderReader:
        """See `LabelledFolder`."""
        cameras = read_cameras(self.root / "cameras.json", self.fov)
        cameras.check_names(images, problems)
        return _PhotoReader(self._classes, self.depth_units_per_m, cameras)
