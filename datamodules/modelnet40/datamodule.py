"""ModelNet40 (Wu et al. 2015): 12,311 meshes of 40 classes, as spheres.

The meshes are free for research: https://modelnet.cs.princeton.edu (``ModelNet40.zip``, 2 GB). See
`shape_files` for the layouts and `meshes` for the spheres. Any other data set with the same layout
can be used, such as ModelNet10.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from torch import Tensor

from datamodules.core.splits import DatasetIndex, Split, draw_groups
from datamodules.core.inputs import Normalization
from datamodules.core.labels import IMAGE_CLASS
from datamodules.core.problems import Problems
from datamodules.core.processes import in_processes
from datamodules.core.split_module import SplitDataModule
from datamodules.core.store import Declared, Store
from datamodules.modelnet40.meshes import CHANNELS
from datamodules.modelnet40.shape_files import MODELNET40, ShapeFile, find_shapes
from datamodules.modelnet40.shape_samples import (
    MOST_STEPS,
    SPHERE_NORMALIZATION,
    ShapeSample,
    ShapeViews,
    Spheres,
    TestRotation,
    make_spheres,
    normalize_spheres,
)
from tangent_train.errors import DataError
from tangent_train.rendering import TangentRepresentation

_PER_PROCESS = 40


@dataclass(kw_only=True, eq=False, repr=False)
class ModelNet40(SplitDataModule[ShapeFile]):
    """Shapes as spheres, for classification.

    The spheres are computed once, on all cores, before the first run (`prepare_data`), into a
    folder for their size, ``spheres_<height>x<width>``, of `store`, by default of `root`.
    Validation takes the same share of the training shapes of every class, drawn from the seed.

    Args:
        batch_size: Shapes per training step and process, and in every step of evaluation.
        test_rotation: Rotate the test shapes: `yaw` about the vertical, `so3` uniformly over all
            rotations; with the same seed, a shape is rotated equally in every run.

    Attributes:
        class_names: Names of the classes in alphabetical order; those of ModelNet40 while `root`
            is missing.
        erp_height: Rows of the spherical images.

    Raises:
        SettingError: A setting is invalid.
        DataError: `root` does not contain a tree of meshes.
    """

    noun: ClassVar[str] = "shapes"
    labels = IMAGE_CLASS
    fact_settings: ClassVar[tuple[str, ...]] = ("test_rotation",)

    batch_size: int = 16
    test_rotation: TestRotation = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_representation("erp_height", "tangent")
        self.require(
            "test_rotation", self.test_rotation in (None, "yaw", "so3"), "null, yaw or so3"
        )
        self.erp_height: int = self.representation.erp_height
        self.class_names = self.find_classes()
        given = self.normalization or SPHERE_NORMALIZATION
        self.normalization = Normalization.of(given, CHANNELS, "data.normalization")

    def default_representation(self) -> TangentRepresentation:
        """Tangent images of base level 0, at level 5."""
        return TangentRepresentation(0, 5 if self.level is None else self.level)

    def find_classes(self) -> tuple[str, ...]:
        """Return the names of the classes, even before the files exist."""
        if not self.root.exists():
            return MODELNET40
        return tuple(sorted({mesh.label for mesh in find_shapes(self.root)}))

    def find(self, problems: Problems) -> DatasetIndex[ShapeFile]:
        """See `LabeledData`."""
        del problems
        meshes = find_shapes(self.root)
        chosen = self._choose_for_validation(meshes)
        splits: dict[Split, list[ShapeFile]] = {"train": [], "val": [], "test": []}
        for mesh in meshes:
            splits["val" if mesh.name in chosen else mesh.part].append(mesh)
        for split in ("train", "test"):
            if not splits[split]:
                raise DataError(self.root, found=f"no {split} shape", expected="some")
        shape = self.erp_height, 2 * self.erp_height
        folder = (self.store or self.root) / f"spheres_{shape[0]}x{shape[1]}"
        store = Store(folder, {"spheres": Declared("uint16", (*shape, CHANNELS), MOST_STEPS)})
        return DatasetIndex(
            self.noun, splits, partial(make_spheres, shape), Spheres, store, _in_processes
        )

    def dataset(self, split: Split) -> ShapeViews:
        """See `LabeledData`: samples `ShapeSample`; the test shapes are rotated if set."""
        source, views = self.source(split), (self.class_names, self.representation)
        if split == "train":
            return ShapeViews(source, *views, (self.seed, self.sampling_seed), random=True)
        rotation = self.test_rotation if split == "test" else None
        return ShapeViews(source, *views, self.seed, rotation=rotation)

    @property
    def in_channels(self) -> int:
        """Number of channels of a sphere."""
        return CHANNELS

    def normalized(self, batch: ShapeSample) -> Tensor:
        """Return the normalized views of a `ShapeSample`, ``(B, N, 6, h, w)`` float32."""
        normalization: Any = self.normalization
        return normalize_spheres(batch.images, normalization)

    def evaluation_size(self) -> int:
        """Shapes per evaluation batch: as many as in training."""
        return self.per_step

    def _choose_for_validation(self, meshes: Sequence[ShapeFile]) -> set[str]:
        """Draw the names of validation shapes: the same share of every class's training shapes.

        Broken meshes are included, so that the draw does not depend on them.
        """
        chosen: set[str] = set()
        for number, label in enumerate(self.class_names if self.val_fraction else ()):
            names = [m.name for m in meshes if m.label == label and m.part == "train"]
            chosen |= draw_groups(names, self.val_fraction, (self.seed, number))
        return chosen


def _in_processes(work: Callable[[ShapeFile], Any], meshes: Sequence[ShapeFile]) -> Generator[Any]:
    # Not threads: reading meshes holds the GIL.
    return in_processes(work, [(mesh,) for mesh in meshes], least=_PER_PROCESS)
