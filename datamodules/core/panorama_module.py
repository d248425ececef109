"""What the data modules of all panorama data sets share: the prepared store, turned test images."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from lightning.pytorch.trainer.states import TrainerFn

from datamodules.core.panoramas import FileSource, Panorama, ReadablePanoramas, Turn
from datamodules.core.segmentation_module import SPLITS, SegmentationDataModule, Split
from datamodules.core.sources import read_strictly
from datamodules.core.store import PreparedPanoramas, prepare_store
from datamodules.core.turned_panoramas import PosedPanoramas, TurnedPanoramas, UprightPanoramas
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from datamodules.core.sources import ImageSource
    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["PanoramaDataModule", "Split"]

_HALF_TURN_DEG = 180

Upright = Literal["pose", "auto"] | None
"""Where it is known from which way is up in a panorama."""


class PanoramaDataModule(SegmentationDataModule[Panorama]):
    """Panoramas of one data set.

    A data set says which panoramas it has (`find_splits`) and its `class_names`.

    Args:
        representation: What the network sees of a panorama.
        panoramas_per_step: Panoramas per training step and process.
        store: Folder of a prepared store, see `store`: panoramas are decoded once, then read from
            there. The samples are the same without.
        test_rotation: Turn the test panoramas: tilt in degrees, or `so3`, see `TurnedPanoramas`.
        upright: Look at panoramas upright that are not. `pose`: as their files say (GPano) and, of
            test panoramas, as they were turned. `auto`: as their files say, else as estimated from
            the image.
        max_tilt_deg: Of `auto`: some degrees more than they are tilted, see `estimate_up`.
        **settings: All others of `SegmentationDataModule`.

    Attributes:
        erp_height: Rows of the panoramas read.

    Raises:
        SettingError: A setting that cannot work.
    """

    noun: ClassVar[str] = "panoramas"

    def __init__(
        self,
        representation: Representation,
        *,
        panoramas_per_step: int = 4,
        store: str | Path | None = None,
        test_rotation: Turn = None,
        upright: Upright = None,
        max_tilt_deg: float = 60.0,
        **settings: Any,
    ) -> None:
        if not hasattr(representation, "erp_height"):
            raise SettingError(
                "representation",
                found=type(representation).__name__,
                expected="one for panoramas",
                remedy="Choose representation=tangent, or photos, as data=synthrooms_perspective.",
            )
        super().__init__(representation, panoramas_per_step, **settings)
        self.erp_height = representation.erp_height
        self.store = None if store is None else Path(store)
        self.test_rotation = _checked_rotation(test_rotation)
        if upright not in (None, "pose", "auto"):
            raise SettingError("data.upright", found=upright, expected="null, pose or auto")
        if not 0 < max_tilt_deg <= _HALF_TURN_DEG:
            raise SettingError(
                "data.max_tilt_deg", found=max_tilt_deg, expected="more than 0, at most 180"
            )
        self.upright = upright
        self.max_tilt_deg = max_tilt_deg

    @abstractmethod
    def find_splits(self) -> Mapping[Split, FileSource]:
        """The panoramas of all splits as they are on disk, see `SegmentationDataModule`."""

    def open_split(self, split: Split) -> FileSource:
        """The panoramas of one split as they are on disk."""
        source: Any = super().open_split(split)  # one that `find_splits` gave
        return source

    def read_once(self, source: ImageSource[Panorama], index: int) -> None:
        """See `SegmentationDataModule`; what is in the store can be read."""
        files: Any = source
        if self.store is not None:
            try:
                PreparedPanoramas(files, self.store).checked(index, content=False)
            except DataError:  # not made yet, or anew
                pass
            else:
                return
        read_strictly(source, index)

    def chosen(self, source: ImageSource[Panorama], indices: Sequence[int]) -> FileSource:
        """Some of the panoramas of a source."""
        files: Any = source
        return ReadablePanoramas(files, indices)

    def sampled_splits(self) -> Sequence[Split]:
        """None with a store: all that it lacks is read whole."""
        return super().sampled_splits() if self.store is None else ()

    def prepare_data(self) -> None:
        """Make the files, and what the store lacks if there is to be one.

        An evaluation prepares the panoramas of the test split only. Before training, those that are
        opened long after its beginning are read whole: damage shows now, and is mended.
        """
        super().prepare_data()
        if self.trainer is not None and self.trainer.state.fn == TrainerFn.TESTING:
            self.prepare_store(("test",))
        else:
            self.prepare_store(whole=("val", "test"))

    def prepare_all(self) -> None:
        """Make and check all that there is to make and check before any run, the store as well."""
        super().prepare_all()
        self.prepare_store(whole=SPLITS)

    def prepare_store(
        self, splits: Sequence[Split] = SPLITS, *, whole: Sequence[Split] = ()
    ) -> None:
        """Make the panoramas that the store lacks; nothing without a store.

        Args:
            splits: Which.
            whole: Those of them whose files are read, for damage that does not show otherwise.

        Raises:
            DataError: The disk is too full, or a file of the data set is broken.
        """
        if self.store is not None:
            sources = {s: PreparedPanoramas(self.open_split(s), self.store) for s in splits}
            prepare_store(list(sources.values()), whole=[sources[split] for split in whole])

    def opened(self, split: Split) -> ImageSource[Panorama]:
        """The panoramas of one split: from the store, turned, looked at upright, if asked for."""
        files = self.open_split(split)
        source: ImageSource[Panorama] = files
        if self.store is not None:
            source = PreparedPanoramas(files, self.store)
        if self.upright is not None:
            source = PosedPanoramas(source, files)
        if split == "test" and self.test_rotation is not None:
            known = self.upright == "pose"
            source = TurnedPanoramas(source, self.test_rotation, self.seed, known=known)
        if self.upright == "auto":
            source = UprightPanoramas(source, self.max_tilt_deg)
        return source


def _checked_rotation(rotation: object) -> Turn:
    if rotation is None:
        return None
    if rotation == "so3":
        return "so3"
    if isinstance(rotation, int | float) and 0 <= rotation <= _HALF_TURN_DEG:
        return float(rotation)
    raise SettingError(
        "data.test_rotation",
        found=repr(rotation),
        expected="null, a tilt of 0 to 180 degrees, or so3",
    )
