"""Which pictures of Stanford2D3DS are for training, validation and test."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from datamodules.core.group_drawing import draw_groups
from datamodules.core.label_table import LabelTable
from datamodules.core.problems import Noted, raised
from datamodules.core.segmentation_module import Split
from datamodules.stanford2d3ds.files import AREAS, FOLDS, GET_IT, PictureFiles, check_cameras
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


__all__ = ["StanfordSplits"]

_TABLE_NAME = "semantic_labels.json"


class StanfordSplits:
    """The three folds of the authors of the data set, with rooms for validation.

    Validation pictures are those of whole rooms drawn from the training areas, so that nothing is
    ever chosen by the test areas.

    Args:
        root: Folder with ``area_1`` … ``area_6``.
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there.
        validation_fraction: Share of the training rooms for validation: at least one room, never
            all; 0 for no validation.
        seed: Chooses the validation rooms.
        label_table: The class table, when it is not where the release has it.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        fold: int = 1,
        areas: Sequence[str] = AREAS,
        validation_fraction: float = 0.1,
        seed: int = 0,
        label_table: str | Path | None = None,
    ) -> None:
        if fold not in FOLDS:
            raise SettingError("data.fold", found=repr(fold), expected="1, 2 or 3")
        if not 0 <= validation_fraction < 1:
            raise SettingError(
                "data.validation_fraction", found=validation_fraction, expected="0 to below 1"
            )
        testing = set(FOLDS[fold])
        if not set(areas) <= set(AREAS) or not testing & set(areas) or set(areas) <= testing:
            raise SettingError(
                "data.areas",
                found=list(areas),
                expected=f"some of {', '.join(AREAS)}: for testing (fold {fold}: "
                f"{', '.join(FOLDS[fold])}) and for training (others)",
            )
        self.root = Path(root)
        self.areas = tuple(areas)
        self._testing = testing
        self._fraction = validation_fraction
        self._seed = seed
        self._label_table = None if label_table is None else Path(label_table)

    def read_label_table(self, noted: Noted = raised) -> LabelTable:
        """The class table, after a look at the folders.

        Args:
            noted: Where missing areas go, to go on after them.

        Raises:
            DataError: An area or the table is missing, or the table cannot be used.
        """
        if not self.root.is_dir():
            raise DataError(
                self.root, found="no such folder", expected="the data set", remedy=GET_IT
            )
        missing = [f"area_{area}" for area in self.areas if not self._is_there(area)]
        with noted():
            if missing:
                raise DataError(
                    self.root,
                    found="no " + ", ".join(missing),
                    expected="all of " + ", ".join(f"area_{area}" for area in self.areas),
                    remedy=GET_IT,
                )
        return LabelTable.from_json(self._find_table())

    def divide(
        self, list_area: Callable[[str], list[PictureFiles]], noted: Noted = raised
    ) -> dict[Split, list[PictureFiles]]:
        """The pictures of every split.

        Args:
            list_area: Gives those of an area that is there.
            noted: Where pictures that are there twice go, to go on after them.

        Raises:
            DataError: There is only one room to train on, and one is wanted for validation; or
                pictures are there twice.
        """
        there = [area for area in self.areas if self._is_there(area)]
        files = [picture for area in there for picture in list_area(area)]
        check_cameras(files, noted)
        training = [picture for picture in files if picture.area not in self._testing]
        rooms = self._choose_rooms(training)
        return {
            "train": [picture for picture in training if picture.room not in rooms],
            "val": [picture for picture in training if picture.room in rooms],
            "test": [picture for picture in files if picture.area in self._testing],
        }

    def _is_there(self, area: str) -> bool:
        return (self.root / f"area_{area}").is_dir()

    def _find_table(self) -> Path:
        if self._label_table is not None:
            return self._label_table
        places = (self.root / _TABLE_NAME, self.root / "assets" / _TABLE_NAME)
        for place in places:
            if place.is_file():
                return place
        raise DataError(
            places[0],
            found="no class table",
            expected=f"it there or at {places[1]}",
            remedy="Copy it from the release (assets), or name it in data.label_table.",
        )

    def _choose_rooms(self, files: Sequence[PictureFiles]) -> set[tuple[str, str, int]]:
        """Draw the rooms for validation, the same for the same seed."""
        if self._fraction == 0:
            return set()
        rooms = draw_groups((picture.room for picture in files), self._fraction, self._seed)
        if files and not rooms:
            raise DataError(
                self.root,
                found="one training room",
                expected="two or more, to keep some for validation",
                remedy="Set data.validation_fraction=0, or use more rooms.",
            )
        return rooms
