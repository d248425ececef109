"""Training, validation and test splits of a user-defined data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lightning.pytorch.utilities import rank_zero_warn

from datamodules.core.files import SPLITS, ImageFiles, Problems, Split, draw_groups
from tangent_train.errors import DataError, counted
from tangent_train.io.image_files import composed


@dataclass(frozen=True)
class FolderSplits:
    """Splits listed in ``train.txt``, ``val.txt`` and ``test.txt``, or drawn at random.

    Scenes (top-level folders in ``images/``) are drawn as a whole, because images of the same room
    or street are similar. Images outside folders are drawn individually; so are the images of a
    single scene, with a warning.

    Attributes:
        root: Folder of the data set, with or without lists. Without ``test.txt``, the test images
            are all unlisted ones if there is a ``train.txt``, else drawn. Without ``train.txt``,
            all other images are for training. Without ``val.txt``, the validation images are
            drawn from the training images.
        test_fraction: Share of the scenes to draw for the test: at least one, at most all but one.
        val_fraction: Share of the training scenes to draw for validation: at least one, at
            most all but one; 0 for no validation, even with a list.
        seed: Seed of the draw.
    """

    root: Path
    test_fraction: float
    val_fraction: float
    seed: int

    def divide(
        self, images: Sequence[ImageFiles], problems: Problems
    ) -> dict[Split, list[ImageFiles]]:
        """Return the images of every split, in their given order.

        Args:
            images: All images of the data set.
            problems: Collects invalid lines of lists.

        Raises:
            DataError: A list cannot be used, or there are too few images to draw a test from.
        """
        listed = self._read_lists(images, problems)
        named = {name for names in listed.values() for name in names}
        rest = {files.name for files in images} - named
        if "test" in listed or "train" in listed:
            test = self._some("test", listed.get("test", rest))
        else:
            test = self._draw("test", images, rest, self.test_fraction)
        train = self._some("train", listed.get("train", rest - test))
        held: set[str] = set()
        if self.val_fraction and "val" in listed:
            held = self._some("val", listed["val"])
        elif self.val_fraction:
            held = self._draw("val", images, train, self.val_fraction)
        chosen: dict[Split, set[str]] = {"train": train - held, "val": held, "test": test}
        return {split: [f for f in images if f.name in chosen[split]] for split in SPLITS}

    def _read_lists(
        self, images: Sequence[ImageFiles], problems: Problems
    ) -> dict[Split, set[str]]:
        """Read the names in each existing list."""
        # Lists may name images with or without their suffix.
        names = {f.name + suffix: f.name for f in images for suffix in ("", f.rgb.suffix)}
        listed: dict[Split, set[str]] = {}
        owners: dict[str, Path] = {}
        for split in SPLITS:
            path = self.root / f"{split}.txt"
            if not path.is_file():
                continue
            listed[split] = set()
            for line in _lines(path):
                with problems.noted(f"{path.name}: {line}"):
                    listed[split].add(_listed_name(path, line, names, owners))
        return listed

    def _draw(
        self, split: Split, images: Sequence[ImageFiles], names: set[str], fraction: float
    ) -> set[str]:
        """Draw the names of the images of some scenes."""
        # Scenes are top-level folders; an image outside folders is a separate scene.
        groups = {f.name: f.name.partition("/")[0] for f in images if f.name in names}
        if len(set(groups.values())) == 1 < len(groups):
            rank_zero_warn(
                f"All {len(groups)} images to draw those of {split} from are in one scene, "
                f"{next(iter(groups.values()))}. They are drawn one by one: scores will be better "
                "than on places that are new to the network.",
                category=UserWarning,
            )
            groups = {name: name for name in groups}
        drawn = draw_groups(groups.values(), fraction, [self.seed, SPLITS.index(split)])
        if not drawn and split == "test":
            raise DataError(
                self.root / "images",
                found=f"{counted(len(groups), 'images')} to draw those of test from",
                expected="two or more",
                remedy="Add images, or name some in test.txt.",
            )
        return {name for name, group in groups.items() if group in drawn}

    def _some(self, split: Split, names: set[str]) -> set[str]:
        """Return the names if there are any."""
        if not names:
            raise DataError(
                self.root,
                found=f"no images for {split}",
                expected="one or more",
                remedy=f"Name some in {split}.txt; without validation, set data.val_fraction=0.",
            )
        return names


def _listed_name(path: Path, line: str, names: dict[str, str], owners: dict[str, Path]) -> str:
    """Return the image named in a line of a list, and assign it to that list."""
    if line not in names:
        raise DataError(
            path,
            found=f"{line!r}, which is not an image",
            expected="names of files in images/, e.g. scene/name",
        )
    name = names[line]
    if name in owners:
        raise DataError(
            path,
            found=f"{line!r}, also in {owners[name]}",
            expected="every image once, in one of the lists",
        )
    owners[name] = path
    return name


def _lines(path: Path) -> list[str]:
    """Read the names in a list, without empty lines and comments (#)."""
    try:
        lines = [composed(line.strip()) for line in path.read_text("utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, found=error, expected="names, one per line, in UTF-8") from error
    return [line for line in lines if line and not line.startswith("#")]
