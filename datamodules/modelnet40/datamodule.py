"""ModelNet40 (Wu et al. 2015): 12,311 meshes of 40 classes, as spheres.

The meshes are free for research: https://modelnet.cs.princeton.edu (``ModelNet40.zip``, 2 GB). See
`shape_files` for the layouts and `meshes` for the spheres. Any other data set with the same layout
can be used, such as ModelNet10.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import PositiveInt
from torch import Tensor

from datamodules.core.data_module import DataModule, data_set
from datamodules.core.image_module import check_representation
from datamodules.core.inputs import Normalization
from datamodules.core.labels import IMAGE_CLASS
from datamodules.core.processes import in_processes
from datamodules.core.splits import Split, draw_groups
from datamodules.modelnet40.meshes import CHANNELS, clean_mesh, mesh_spheres, read_off
from datamodules.modelnet40.shape_files import MODELNET40, ShapeFile, find_shapes
from datamodules.modelnet40.shape_samples import (
    SPHERE_NORMALIZATION,
    STEPS,
    ShapeSample,
    ShapeViews,
    Spheres,
    TestRotation,
    normalize_spheres,
)
from tangent_train.errors import DataError
from tangent_train.rendering import TangentRepresentation

_PER_PROCESS = 40


@data_set
class ModelNet40(DataModule):
    """Shapes as spheres, for classification.

    The spheres are computed once, on all cores, before the first run (`prepare_data`), into the
    `cache`, by default the folder ``spheres`` of `root`.
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
    kind = Spheres
    labels = IMAGE_CLASS
    fact_settings: ClassVar[tuple[str, ...]] = ("test_rotation",)

    batch_size: PositiveInt = 16
    test_rotation: TestRotation = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_representation(self, "erp_height", "tangent")
        self.cache = self.cache or self.root / "spheres"
        self.erp_height: int = self.representation.erp_height
        self.class_names = self.find_classes()  # type: ignore[misc]
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

    def files(self, split: Split) -> list[ShapeFile]:
        """See `DataModule`."""
        meshes = find_shapes(self.root)
        chosen = self._choose_for_validation(meshes)
        found = [m for m in meshes if split == ("val" if m.name in chosen else m.part)]
        if not found and split != "val":
            raise DataError(self.root, found=f"no {split} shape", expected="some")
        return found

    def read(self, files: ShapeFile) -> Spheres:
        """See `DataModule`: a mesh as seen from the sphere around it."""
        values = mesh_spheres(
            clean_mesh(read_off(files.path)), (self.erp_height, 2 * self.erp_height)
        )
        return Spheres(np.rint(values * STEPS).astype(np.uint16))

    def decode_settings(self) -> dict[str, Any]:
        """See `DataModule`."""
        return {"rows": self.erp_height}

    def in_parallel(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Generator[Any]:
        """See `DataModule`; not in threads, because reading meshes holds the GIL."""
        return in_processes(work, [(item,) for item in items], least=_PER_PROCESS)

    def build_dataset(self, split: Split) -> ShapeViews:
        """See `DataModule`: samples `ShapeSample`; the test shapes are rotated if set."""
        return ShapeViews(self, split)

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
        return self.batch_size

    def _choose_for_validation(self, meshes: Sequence[ShapeFile]) -> set[str]:
        """Draw the names of validation shapes: the same share of every class's training shapes.

        Broken meshes are included, so that the draw does not depend on them.
        """
        chosen: set[str] = set()
        for number, label in enumerate(self.class_names if self.val_fraction else ()):
            names = [m.name for m in meshes if m.label == label and m.part == "train"]
            chosen |= draw_groups(names, self.val_fraction, (self.seed, number))
        return chosen
