"""Training, validation and test splits of a user-defined data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightning.pytorch.utilities import rank_zero_warn

from datamodules.core.files import SPLITS, ImageFiles, Problems, Split, draw_groups
from tangent_train.errors import DataError
from tangent_train.files import checked_file
from tangent_train.io.image_files import composed, lower_suffix


def divide_images(
    root: Path,
    images: Sequence[ImageFiles],
    problems: Problems,
    fractions: tuple[float, float],
    seed: int,
) -> dict[Split, list[ImageFiles]]:
    """Return the images of every split, listed in ``train.txt`` …, or drawn at random.

    Scenes (top-level folders in ``images/``) are drawn as a whole, because images of the same room
    or street are similar. Images outside folders are drawn individually; so are the images of a
    single scene, with a warning. Without ``test.txt``, the test images are all unlisted ones if
    there is a ``train.txt``, else drawn. Without ``train.txt``, all other images are for training.
    Without ``val.txt``, the validation images are drawn from the training images.

    Args:
        root: Folder of the data set, with or without lists.
        images: All images of the data set.
        problems: Collects invalid lines of lists.
        fractions: Share of the scenes to draw for the test: at least one, at most all but one; 1
            for all. The same of the training scenes for validation; 0 for no validation, even with
            a list.
        seed: Seed of the draw.

    Raises:
        DataError: A list cannot be used, or there are no images for the test.
    """
    listed = _read_lists(root, images, problems)
    rest = {files.name for files in images}.difference(*listed.values())
    held: set[str] = set()
    if "test" in listed or "train" in listed or fractions[0] == 1:
        test = listed.get("test", rest)
    else:
        test = _draw("test", rest, fractions[0], seed)
    train = listed.get("train", rest - test)
    if fractions[1] and train:
        held = listed["val"] if "val" in listed else _draw("val", train, fractions[1], seed)
    chosen: dict[Split, set[str]] = {"train": train - held, "val": held, "test": test}
    if not test:
        remedy = "Add images, name some in test.txt, or give data.test_fraction=1 to score all."
        raise DataError(root, found="no images for test", expected="one or more", remedy=remedy)
    return {split: [f for f in images if f.name in chosen[split]] for split in SPLITS}


def _read_lists(
    root: Path, images: Sequence[ImageFiles], problems: Problems
) -> dict[Split, set[str]]:
    """Read the names in each existing list: one per line, without comments (#)."""
    # Lists may name images with or without their suffix.
    free = {lower_suffix(f.name + f.rgb.suffix): f.name for f in images}
    free |= {f.name: f.name for f in images}
    listed: dict[Split, set[str]] = {}
    for split in SPLITS:
        path = root / f"{split}.txt"
        path = path if path.exists() else path.with_suffix(".TXT")
        if not path.exists():
            continue
        lines = [
            composed(line.strip())
            for line in checked_file(path).read_text("utf-8-sig").splitlines()
        ]
        listed[split] = set()
        for line in lines:
            slashed = line.replace("\\", "/")  # of Windows
            name = free.get(line) or free.get(slashed) or free.get(lower_suffix(slashed))
            with problems.noted(f"{path.name}: {line}"):
                if name in set().union(*listed.values()) or not (name or line[:1] in "#"):
                    expected = "names of files in images/, each once, e.g. scene/name"
                    raise DataError(path, found=repr(line), expected=expected)
            if name:
                listed[split].add(name)
    return listed


def _draw(split: Split, names: set[str], fraction: float, seed: int) -> set[str]:
    """Draw the names of the images of some scenes."""
    # Scenes are top-level folders; an image outside folders is a separate scene.
    groups = {name: name.partition("/")[0] for name in names}
    if len(set(groups.values())) == 1 < len(groups):
        rank_zero_warn(
            f"All {len(groups)} images to draw those of {split} from are in one scene, "
            f"{next(iter(groups.values()))}. They are drawn one by one: scores will be better "
            "than on places that are new to the network.",
            category=UserWarning,
        )
        groups = {name: name for name in groups}
    drawn = draw_groups(groups.values(), fraction, [seed, SPLITS.index(split)])
    return {name for name, group in groups.items() if group in drawn}
