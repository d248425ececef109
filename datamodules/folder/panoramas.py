"""One's own panoramas: a folder of images, one of label images, and a list of classes.

On disk::

    root/
      classes.json                  see `read_classes`
      images/[scene/]…/name.jpg     or .png, .tif, .webp: 360°×180°, twice as wide as high
      labels/[scene/]…/name.png     values or colours of the classes, at the size of the image
      depth/[scene/]…/name.png      or .tif, .npy, .exr, if depth is an input, see `read_depth_m`
      train.txt val.txt test.txt    if wanted, names one per line, see `FolderSplits`
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.core.panorama_module import PanoramaDataModule, Split
from datamodules.core.panoramas import (
    Panorama,
    meters_to_steps,
    resize_area,
    resize_depth,
    resize_nearest,
)
from datamodules.core.samples import Input, Normalization
from datamodules.core.sources import count_labels, in_threads
from datamodules.folder.classes import UNKNOWN_NAME, read_classes
from datamodules.folder.files import (
    check_class_codes,
    check_panorama,
    list_panoramas,
    read_codes,
)
from datamodules.folder.splits import FolderSplits
from datamodules.images.pixel_files import read_depth_m, read_rgb
from tangent_train.errors import SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from datamodules.folder.classes import FolderClasses
    from datamodules.folder.files import PanoramaFiles
    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["FolderPanoramas", "FolderSource"]


class FolderSource:
    """Reads panoramas at one size.

    Args:
        panoramas: Which.
        classes: What their labels mean.
        erp_height: Rows to read.
        depth_units_per_m: Units in a metre of depth files of whole numbers.
    """

    def __init__(
        self,
        panoramas: Sequence[PanoramaFiles],
        classes: FolderClasses,
        erp_height: int,
        depth_units_per_m: float,
    ) -> None:
        self._panoramas = tuple(panoramas)
        self._classes = classes
        self._shape = (erp_height, 2 * erp_height)
        self._depth_units_per_m = depth_units_per_m

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the panoramas."""
        return self._shape

    @property
    def variant(self) -> str:
        """The size."""
        return f"{self._shape[0]}x{self._shape[1]}"

    @property
    def settings(self) -> dict[str, str]:
        """The size, the classes in short and, where depth is read, its units."""
        settings = {"size": self.variant, "classes": self._classes.fingerprint}
        if any(files.depth is not None for files in self._panoramas):
            settings["depth units per metre"] = f"{self._depth_units_per_m:g}"
        return settings

    def files(self, index: int) -> dict[str, Path]:
        """The file of every part of one panorama."""
        return self._panoramas[index].parts

    def __len__(self) -> int:
        return len(self._panoramas)

    def name(self, index: int) -> str:
        """The path of a panorama in ``images/`` without ending, as ``kitchen/seen_from_door``."""
        return self._panoramas[index].name

    def read(self, index: int) -> Panorama:
        """One panorama.

        Raises:
            DataError: A file is broken.
        """
        return self._read(index, strict=False)

    def read_strictly(self, index: int) -> Panorama:
        """The same, if all its values are in the list of classes, where that is a list.

        Raises:
            DataError: A file is broken, or they are not.
        """
        return self._read(index, strict=True)

    def readers(self, index: int) -> Iterator[Callable[[], object]]:
        """What reads the files of one panorama, one after the other."""
        files = self._panoramas[index]
        yield lambda: read_rgb(files.rgb)
        yield lambda: self._labels(files.labels, strict=True)
        if files.depth is not None:
            depth = files.depth
            yield lambda: read_depth_m(depth, self._depth_units_per_m)

    def _read(self, index: int, *, strict: bool) -> Panorama:
        files = self._panoramas[index]
        depth = None
        if files.depth is not None:
            steps = meters_to_steps(read_depth_m(files.depth, self._depth_units_per_m))
            depth = resize_depth(steps, self._shape)
        rgb = resize_area(read_rgb(files.rgb), self._shape)
        return Panorama(rgb, depth, self._labels(files.labels, strict=strict))

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one panorama, ``(256,)``.

        Raises:
            DataError: A file is broken.
        """
        return count_labels(self._labels(self._panoramas[index].labels))

    def _labels(self, path: Path, *, strict: bool = False) -> NDArray[np.uint8]:
        codes = read_codes(path, in_colors=self._classes.in_colors)
        if strict:
            self._classes.check(codes, path)
        return self._classes.decode(resize_nearest(codes, self._shape))


@registered
class FolderPanoramas(PanoramaDataModule):
    """One's own panoramas, with the classes of ``classes.json``.

    Args:
        root: Folder with ``classes.json``, ``images/`` and ``labels/``.
        representation: What the network sees of a panorama.
        test_fraction: Share of the scenes for test, unless there are lists, see `FolderSplits`.
        validation_fraction: Share of the training scenes for validation, likewise.
        split_seed: Of the drawing of both. Not the seed of the run: networks of other seeds are
            compared on the same panoramas, and none is ever tested on what another was trained on.
        depth_units_per_m: Units in a metre of depth files of whole numbers, 1000 for millimetres.
        inputs: See `SegmentationDataModule`. Depth is clipped to 4 m.
        normalization: Of RGB and depth, or a mapping with its `mean` and `std`; by default
            that of Stanford2D3DS.
        **settings: All others of `PanoramaDataModule`.

    Attributes:
        class_names: "unknown", then those of ``classes.json``.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        *,
        test_fraction: float = 0.2,
        validation_fraction: float = 0.1,
        split_seed: int = 0,
        depth_units_per_m: float = 1000,
        inputs: Sequence[Input] = ("rgb",),
        normalization: Normalization | Mapping[str, Sequence[float]] | None = None,
        **settings: Any,
    ) -> None:
        normalization = _normalization(normalization)
        super().__init__(representation, inputs=inputs, normalization=normalization, **settings)
        if not depth_units_per_m > 0:
            raise SettingError(
                "data.depth_units_per_m", found=depth_units_per_m, expected="more than 0"
            )
        self.root = Path(root)
        self.validation_fraction = validation_fraction
        self.depth_units_per_m = depth_units_per_m
        self._division = FolderSplits(self.root, test_fraction, validation_fraction, split_seed)
        # Now, not with the files: the network is made for as many classes.
        self._classes = read_classes(self.root / "classes.json")
        self.class_names = (UNKNOWN_NAME, *self._classes.names)

    def find_splits(self) -> dict[Split, FolderSource]:
        """The panoramas of all splits, checked.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: The panoramas are too small for the representation.
        """
        noted, classes = self.problems.noted, self._classes
        panoramas = list_panoramas(self.root, with_depth=self.with_depth, noted=noted)
        # Before any are left out: the splits do not depend on what is broken.
        splits = self._division.divide(panoramas, noted)

        def check(index: int) -> None:
            files = panoramas[index]
            check_panorama(files, self.erp_height, in_colors=classes.in_colors, noted=noted)

        for _ in in_threads(check, len(panoramas)):
            pass
        check_class_codes(self._whole(panoramas), classes, noted)
        return {
            split: FolderSource(
                self._whole(chosen), classes, self.erp_height, self.depth_units_per_m
            )
            for split, chosen in splits.items()
        }

    def _whole(self, panoramas: Sequence[PanoramaFiles]) -> list[PanoramaFiles]:
        """Those that nothing was noted of."""
        broken = self.problems.items
        return [files for files in panoramas if files.name not in broken]


def _normalization(
    given: Normalization | Mapping[str, Sequence[float]] | None,
) -> Normalization | None:
    if given is None or isinstance(given, Normalization):
        return given
    if set(given) != {"mean", "std"}:
        raise SettingError("data.normalization", found=dict(given), expected="mean and std")
    return Normalization(given["mean"], given["std"])
