"""ModelNet40 (Wu et al. 2015): 12,311 meshes of 40 classes, as spheres.

The meshes are free for research: https://modelnet.cs.princeton.edu (``ModelNet40.zip``, 2 GB). See
`shape_files` about the layouts, `off_files` about the files, `mesh_spheres` about what becomes of
them. Any other tree of the same form does as well, as that of ModelNet10.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lightning.pytorch.trainer.states import TrainerFn

from datamodules.core.group_drawing import draw_groups
from datamodules.core.processes import in_processes, number_of_processes
from datamodules.core.samples import Normalization
from datamodules.core.split_module import Kind, Split, SplitDataModule
from datamodules.modelnet40.shape_files import MODELNET40, ShapeFile, find_shapes
from datamodules.modelnet40.shape_samples import (
    SPHERE_NORMALIZATION,
    EvaluationShapes,
    ShapeSample,
    TestRotation,
    TrainingShapes,
    normalize_spheres,
)
from datamodules.modelnet40.sphere_files import mesh_problem
from datamodules.modelnet40.sphere_store import Shapes, SphereFolder
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from torch import Tensor

    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["ModelNet40"]

_PER_PROCESS = 100


@registered
class ModelNet40(SplitDataModule[Shapes]):
    """Shapes as spheres, to be classified.

    The spheres are made once, on all cores, before the first run (`prepare_data`).

    Args:
        root: Folder of the meshes, see `shape_files`.
        representation: What the network sees of a sphere; it turns the shapes while training.
        shapes_per_step: Shapes per training step and process, and in every step of evaluation.
        store: Folder in which the prepared spheres get one for their size,
            ``spheres_<height>x<width>``; by default `root`.
        validation_fraction: Share of the training shapes of every class for validation, drawn from
            the seed.
        test_rotation: Turn the test shapes: `yaw` about the vertical, `so3` any way; the same shape
            the same way in every run with the same seed.
        normalization: Of the six channels; by default that of ModelNet40.
        **settings: All others of `SplitDataModule`.

    Attributes:
        class_names: Names of the classes there are, in alphabetical order; those of ModelNet40 as
            long as `root` is missing.
        erp_height: Rows of the spherical images.

    Raises:
        SettingError: A setting that cannot work.
        DataError: There is something else than meshes in `root`.
    """

    noun: ClassVar[str] = "shapes"
    kind: ClassVar[Kind] = "classification"

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        *,
        shapes_per_step: int = 16,
        store: str | Path | None = None,
        validation_fraction: float = 0.1,
        test_rotation: TestRotation = None,
        normalization: Normalization | Mapping[str, Sequence[float]] | None = None,
        **settings: Any,
    ) -> None:
        if not hasattr(representation, "erp_height"):
            raise SettingError(
                "representation",
                found=type(representation).__name__,
                expected="one for panoramas: the spheres of shapes are such",
                remedy="Choose representation=tangent.",
            )
        normalization = _checked_normalization(normalization)
        super().__init__(representation, shapes_per_step, normalization, **settings)
        if test_rotation not in (None, "yaw", "so3"):
            raise SettingError(
                "data.test_rotation", found=repr(test_rotation), expected="null, yaw or so3"
            )
        if not 0 <= validation_fraction < 1:
            raise SettingError(
                "data.validation_fraction", found=validation_fraction, expected="0 to below 1"
            )
        self.root = Path(root)
        self.validation_fraction = validation_fraction
        self.test_rotation = test_rotation
        self.erp_height = representation.erp_height
        height, width = self.erp_height, 2 * self.erp_height
        folder = Path(self.root if store is None else store) / f"spheres_{height}x{width}"
        self.spheres = SphereFolder(folder, (height, width))
        self._meshes: list[ShapeFile] = []
        self.class_names = self.find_classes()

    def find_classes(self) -> tuple[str, ...]:
        """The names of the classes, before there need be files."""
        if not self.root.exists():
            return MODELNET40
        return tuple(sorted({mesh.label for mesh in self._all_meshes()}))

    def prepare_data(self) -> None:
        """Make the spheres that are missing or out of date; an evaluation needs the test split's.

        Raises:
            DataError: There are no meshes, or no room for the spheres.
        """
        super().prepare_data()
        testing = self.trainer is not None and self.trainer.state.fn == TrainerFn.TESTING
        meshes = self._all_meshes()
        self.spheres.prepare([m for m in meshes if m.part == "test"] if testing else meshes)

    def prepare_all(self) -> None:
        """Make and check all that there is to make and check before any run."""
        self.prepare_data()
        self.setup("fit")

    def find_splits(self) -> dict[Split, Shapes]:
        """The usable shapes of all splits.

        Raises:
            DataError: There are no meshes, or none that can be used.
        """
        meshes = self._all_meshes()
        chosen = self._choose_for_validation(meshes)
        unusable = self.spheres.unusable(meshes)
        splits: dict[Split, list[ShapeFile]] = {"train": [], "val": [], "test": []}
        for mesh in meshes:
            if mesh.name in unusable:
                self._note(mesh, unusable[mesh.name])
            else:
                splits["val" if mesh.name in chosen else mesh.part].append(mesh)
        for split in ("train", "test"):
            if not splits[split]:
                raise DataError(self.root, found=f"no usable {split} shape", expected="some")
        return {split: self._shapes(found) for split, found in splits.items()}

    def content(self, splits: Mapping[Split, Shapes]) -> tuple[int, Iterator[None]]:
        """All meshes, whether their spheres are made or not."""
        del splits
        meshes = self._all_meshes()

        def reading() -> Iterator[None]:
            pieces = [(mesh,) for mesh in meshes]
            processes = number_of_processes(None, len(meshes), _PER_PROCESS)
            for mesh, found in in_processes(_mesh_problem, pieces, processes):
                if found is not None:
                    self._note(mesh, found)
                yield

        return len(meshes), reading()

    def remembered(self, source: Shapes) -> Shapes:
        """Spheres kept in memory."""
        return source.remembered()

    def training_samples(self) -> TrainingShapes:
        """Samples `ShapeSample`, turned as the representation says."""
        return TrainingShapes(self.source("train"), self.representation, self.drawn_from)

    def evaluation_samples(self, split: Split) -> EvaluationShapes:
        """Samples `ShapeSample`: those of the test split turned, if asked for."""
        turn = self.test_rotation if split == "test" else None
        return EvaluationShapes(self.source(split), self.representation, turn, self.seed)

    def evaluation_size(self) -> int:
        """As many shapes as in training."""
        return self.per_step

    def normalized(self, batch: ShapeSample) -> Tensor:
        """The views of a `ShapeSample`, ``(B, N, 6, h, w)`` float32."""
        return normalize_spheres(batch.images, self.normalization)

    def _note(self, mesh: ShapeFile, found: str) -> None:
        self.problems.add(DataError(found), mesh.name, mesh.path)

    def _all_meshes(self) -> list[ShapeFile]:
        """All meshes, looked for once."""
        if not self._meshes:
            self._meshes = find_shapes(self.root)
        return self._meshes

    def _choose_for_validation(self, meshes: Sequence[ShapeFile]) -> set[str]:
        """Names drawn from those for training, of every class the same share.

        Whether a mesh can be used does not matter: the draw is the same before that is known.
        """
        chosen: set[str] = set()
        for number, label in enumerate(self.class_names if self.validation_fraction else ()):
            names = [m.name for m in meshes if m.label == label and m.part == "train"]
            chosen |= draw_groups(names, self.validation_fraction, (self.seed, number))
        return chosen

    def _shapes(self, meshes: Sequence[ShapeFile]) -> Shapes:
        number = {name: place for place, name in enumerate(self.class_names)}
        return Shapes(
            [mesh.name for mesh in meshes],
            [number[mesh.label] for mesh in meshes],
            [self.spheres.path(mesh) for mesh in meshes],
            self.spheres.shape,
        )


def _mesh_problem(mesh: ShapeFile) -> tuple[ShapeFile, str | None]:
    return mesh, mesh_problem(mesh.path)


def _checked_normalization(
    given: Normalization | Mapping[str, Sequence[float]] | None,
) -> Normalization:
    if given is None:
        return SPHERE_NORMALIZATION
    if not isinstance(given, Normalization):
        given = Normalization(**given)
    if given.channels != SPHERE_NORMALIZATION.channels:
        raise SettingError("data.normalization", found=f"{given.channels} channels", expected="six")
    return given
