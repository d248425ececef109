"""Which pictures of Stanford2D3DS are for training, validation and test."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from datamodules.core.group_drawing import draw_groups
from datamodules.stanford2d3ds.files import AREAS, FOLDS, GET_IT, PictureFiles, list_pictures
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from datamodules.core.found import Split
    from datamodules.core.problems import Problems
    from datamodules.core.reading import ImageFiles

__all__ = ["check_choice", "find_pictures"]


def check_choice(fold: int, areas: Sequence[str]) -> None:
    """Make sure that there are areas for training and for testing.

    Raises:
        SettingError: There are not.
    """
    if fold not in FOLDS:
        raise SettingError("data.fold", found=repr(fold), expected="1, 2 or 3")
    testing = set(FOLDS[fold])
    if not set(areas) <= set(AREAS) or not testing & set(areas) or set(areas) <= testing:
        raise SettingError(
            "data.areas",
            found=list(areas),
            expected=f"some of {', '.join(AREAS)}: for testing (fold {fold}: "
            f"{', '.join(FOLDS[fold])}) and for training (others)",
        )


def find_pictures(
    root: Path,
    group: Literal["pano", "data"],
    problems: Problems,
    *,
    fold: int,
    areas: Sequence[str],
    with_depth: bool,
    validation_fraction: float,
    seed: int,
) -> dict[Split, list[ImageFiles]]:
    """The panoramas or photos of every split.

    Validation pictures are those of whole rooms drawn from the training areas, so that nothing is
    ever chosen by the test areas.

    Args:
        root: Folder with ``area_1`` … ``area_6``.
        group: Panoramas or photos.
        problems: Where it is noted what is missing or there twice.
        fold: 1, 2 or 3, see `FOLDS`.
        areas: Areas to use, all of which must be there.
        with_depth: Whether depth is an input.
        validation_fraction: Share of the training rooms: at least one room, never all.
        seed: Chooses the validation rooms.

    Raises:
        DataError: There is no data set, or only one room to train on, and one is wanted for
            validation.
    """
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
    listed = [list_pictures(root, area, group, with_depth, problems) for area in there]
    pictures = [picture for pictures in listed for picture in pictures]
    _check_cameras(pictures, problems)
    training = [picture for picture in pictures if picture.area not in FOLDS[fold]]
    rooms: set[tuple[str, str, int]] = set()
    if validation_fraction:
        rooms = draw_groups((picture.room for picture in training), validation_fraction, seed)
        if training and not rooms:
            raise DataError(
                root,
                found="one training room",
                expected="two or more, to keep some for validation",
                remedy="Set data.validation_fraction=0, or use more rooms.",
            )
    return {
        "train": [picture.image for picture in training if picture.room not in rooms],
        "val": [picture.image for picture in training if picture.room in rooms],
        "test": [picture.image for picture in pictures if picture.area in FOLDS[fold]],
    }


def _check_cameras(pictures: Sequence[PictureFiles], problems: Problems) -> None:
    """Note pictures that are there twice, as a copy in another room or area.

    The two parts of area 5 share rooms, and are always in the same split: a camera may be in both.
    """
    seen: dict[tuple[str, str], list[PictureFiles]] = {}
    for picture in pictures:
        before = seen.setdefault((picture.name.camera, picture.name.frame), [])
        for other in before:
            with problems.noted(picture.image.name):
                if other.area == picture.area or other.room[0] != picture.room[0]:
                    raise DataError(
                        picture.rgb,
                        found=f"the camera of {other.rgb}",
                        expected="every camera in one room of one area",
                        remedy="Remove the copy, with its depth, labels and pose.",
                    )
        before.append(picture)
