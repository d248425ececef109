"""A user's own panoramas: 360°×180°, twice as wide as high, in the tree of `labelled`."""

from __future__ import annotations

from dataclasses import dataclass

from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.folder.labelled import LabelledFolder
from tangent_train.registry import registered

__all__ = ["FolderPanoramas"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class FolderPanoramas(LabelledFolder, PanoramaDataModule):
    """A user's own panoramas, with the classes of ``classes.json``.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting is invalid.
    """
