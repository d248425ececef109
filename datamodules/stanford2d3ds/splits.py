"""Areas, folds and class table of Stanford2D3DS, for panoramas and photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from datamodules.core.found import draw_groups
from datamodules.core.image_module import ImageDataModule
from datamodules.core.reading import ImageFiles
from datamodules.stanford2d3ds.files import AREAS, FOLDS, GET_IT, list_pictures
from datamodules.stanford2d3ds.label_table import CLASSES
from datamodules.stanford2d3ds.reader import StanfordReader
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from datamodules.core.found import Split
    from datamodules.core.problems import Problems

__all__ = ["StanfordAreas"]


@dataclass(kw_only=True, eq=False, repr=False)
class StanfordAreas(ImageDataModule):
    """The three folds of the authors, with rooms for validation.

    Validation pictures are those of whole rooms drawn from the training areas, so that nothing is
    selected on the test areas: at least one room, never all.

    Args:
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must exist; by default all.
        label_table: The class table, if not at the place of the release.

    Attributes:
        group: Kind of pictures.

    Raises:
        SettingError: A setting is invalid.
    """

    class_names = ("unknown", *CLASSES)
    group: ClassVar[Literal["pano", "data"]]

    fold: int = 1
    areas: Sequence[str] = AREAS
    label_table: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.label_table = None if self.label_table is None else Path(self.label_table)
        self.require("fold", self.fold in FOLDS, "1, 2 or 3")
        areas, testing = set(self.areas), set(FOLDS[self.fold])
        self.require(
            "areas",
            areas <= set(AREAS) and bool(testing & areas) and bool(areas - testing),
            f"some of {', '.join(AREAS)}: for testing (fold {self.fold}: "
            f"{', '.join(FOLDS[self.fold])}) and for training (others)",
        )

    @property
    def reader(self) -> StanfordReader:
        """The reader, with the class table of the data set."""
        return StanfordReader.of(self.root, self.label_table)

    def find_images(
        self, problems: Problems
    ) -> tuple[StanfordReader, dict[Split, list[ImageFiles]]]:
        """See `ImageDataModule`."""
        root, areas = self.root, self.areas
        if not root.is_dir():
            raise DataError(root, found="no such folder", expected="the data set", remedy=GET_IT)
        there = [area for area in areas if (root / f"area_{area}").is_dir()]
        with problems.noted():
            if len(there) < len(areas):
                raise DataError(
                    root,
                    found="no " + ", ".join(f"area_{area}" for area in areas if area not in there),
                    expected="all of " + ", ".join(f"area_{area}" for area in areas),
                    remedy=GET_IT,
                )
        with_depth = "depth" in self.inputs
        listed = [list_pictures(root, area, self.group, with_depth, problems) for area in there]
        pictures = [picture for pictures in listed for picture in pictures]
        training = [picture for picture in pictures if picture.area not in FOLDS[self.fold]]
        rooms: set[tuple[str, str, int]] = set()
        if self.validation_fraction:
            rooms = draw_groups((p.room for p in training), self.validation_fraction, self.seed)
        return self.reader, {
            "train": [picture.image for picture in training if picture.room not in rooms],
            "val": [picture.image for picture in training if picture.room in rooms],
            "test": [picture.image for picture in pictures if picture.area in FOLDS[self.fold]],
        }
