"""ModelNet40 (Wu et al. 2015): 12,311 meshes of 40 classes, as spheres.

The meshes are free for research: https://modelnet.cs.princeton.edu (``ModelNet40.zip``, 2 GB). See
`meshes` for the spheres. Any other data set with the same layout can be used, such as ModelNet10.

On disk by class, as released, or by split::

    root/                                   root/
      airplane/                               modelnet40_train/
        train/  airplane_0001.off  …            airplane_0001.off  …  xbox_0103.off
        test/   airplane_0627.off  …          modelnet40_test/
      …                                         airplane_0627.off  …  xbox_0123.off
      xbox/

The class is the folder, or the name of the file without its number. Other files are skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import PositiveInt
from torch import Tensor

from datamodules.core.data_module import DataModule, data_set
from datamodules.core.dataset import SplitDataset, draw_rotation
from datamodules.core.files import SPLITS, Split, draw_groups
from datamodules.core.inputs import Normalization, normalize_channels
from datamodules.core.label_map import IMAGE_CLASS
from datamodules.modelnet40.meshes import CHANNELS, mesh_spheres, read_mesh
from tangent_train.io.image_files import glob_files
from tangent_train.threads import in_processes

MODELNET40 = (
    *("airplane", "bathtub", "bed", "bench", "bookshelf", "bottle", "bowl", "car", "chair", "cone"),
    *("cup", "curtain", "desk", "door", "dresser", "flower_pot", "glass_box", "guitar"),
    *("keyboard", "lamp", "laptop", "mantel", "monitor", "night_stand", "person", "piano"),
    *("plant", "radio", "range_hood", "sink", "sofa", "stairs", "stool", "table", "tent"),
    *("toilet", "tv_stand", "vase", "wardrobe", "xbox"),
)
"""The classes of ModelNet40."""

SPHERE_NORMALIZATION = Normalization(
    mean=(0.7139, 0.6936, 0.5851, 0.5336, 0.7626, 0.5651),
    std=(0.2797, 0.2606, 0.2737, 0.2144, 0.1987, 0.2440),
)
"""The six channels of `mesh_spheres` over ModelNet40 (the released code of the paper)."""

STEPS = 16384
"""Steps of stored values per unit.

Distances are at most 1.99, so 15 bits hold all values with an error of at most 1/32768, less than
2/10000 of a channel's standard deviation. Float16 would take as much space and be eight times as
coarse around 1, and OpenCV does not sample it.
"""

_PER_PROCESS = 40


class ShapeFile(NamedTuple):
    """A mesh of the data set.

    Attributes:
        path: File of the mesh.
        name: Path of the file in the data set, without suffix.
        label: Name of the class.
        part: Split of the mesh.
    """

    path: Path
    name: str
    label: str
    part: Split

    @property
    def paths(self) -> tuple[Path]:
        """Files that the spheres are computed from."""
        return (self.path,)


def find_shapes(root: Path) -> list[ShapeFile]:
    """List all meshes of a data set, ordered by name within each part."""
    shapes = []
    for part in SPLITS[::2]:
        paths = glob_files(root, f"*/{part}/*.off") + glob_files(root, f"modelnet40_{part}/*.off")
        for path in paths:
            by_class = path.parent.name == part
            label = path.parents[1].name if by_class else path.stem.rpartition("_")[0]
            name = path.relative_to(root).with_suffix("").as_posix()
            shapes.append(ShapeFile(path, name, label, part))
    return sorted(shapes, key=lambda shape: (shape.part, shape.name))


class Spheres(NamedTuple):
    """A mesh as seen from the sphere around it.

    Attributes:
        spheres: ``(H, W, 6)`` uint16 in steps of `STEPS`, see `mesh_spheres`.
    """

    spheres: NDArray[np.uint16]


class ShapeSample(NamedTuple):
    """N views of one shape; collating adds a leading batch dimension.

    Attributes:
        images: ``(N, h, w, 6)`` int16 in steps of `STEPS`, which is half the bytes; normalized
            later, to ``(N, 6, h, w)`` float32.
        labels: Class, int64.
        index: Index in its split, int64.
    """

    images: Tensor
    labels: Tensor
    index: Tensor  # type: ignore[assignment]  # hides tuple.index


class ShapeDataset(SplitDataset):
    """Views of shapes, by index or (epoch, index): random ones of training shapes, else all."""

    def sample(self, index: int, rng: np.random.Generator) -> ShapeSample:
        """See `SplitDataset`."""
        spheres = self.read(index).spheres
        images = np.concatenate([v.render(spheres, "bilinear") for v in self._views(index, rng)])
        # torch has few operations on uint16; all values are below 2 · STEPS = 2¹⁵.
        return ShapeSample(
            torch.from_numpy(np.require(images, requirements="W").view(np.int16)),
            torch.tensor(self.data.class_names.index(self.files[index].label)),
            torch.tensor(index),
        )

    def _views(self, index: int, rng: np.random.Generator) -> list[Any]:
        data = self.data
        representation = data.representation
        if self.split == "train":
            return [representation.sample(rng)]
        if self.split == "test" and data.test_rotation is not None:
            # Rotated back, it sees what a rotated shape shows.
            representation = representation.with_rotation(self.shape_rotation(index).T)
        return list(representation.view_sets())

    def shape_rotation(self, index: int) -> NDArray[np.float64]:
        """Return the rotation R of a test shape, ``(3, 3)``: point x moves to R x."""
        is_yaw = self.data.test_rotation == "yaw"
        return draw_rotation(0 if is_yaw else "so3", self.data.seed, index)


@data_set
class ModelNet40(DataModule):
    """Shapes as spheres, for classification.

    The spheres are computed once, on all cores, before the first run (`prepare_data`), into
    `cache`, by default the folder ``spheres`` of `root`. Validation takes the same share of the
    training shapes of every class, drawn from the seed.

    Args:
        batch_size: Shapes per training step and process, and in every step of evaluation.
        test_rotation: Rotate the test shapes: `yaw` about the vertical, `so3` uniformly over all
            rotations; with the same seed, a shape is rotated equally in every run.

    Attributes:
        class_names: Names of the classes in alphabetical order; those of ModelNet40 while `root`
            is missing.
        erp_height: Rows of the spherical images.
    """

    noun: ClassVar[str] = "shapes"
    kind = Spheres
    samples = ShapeDataset
    default_level = 5
    get_it = "Get it from https://modelnet.cs.princeton.edu, or choose data=synthshapes."
    labels = IMAGE_CLASS
    fact_settings: ClassVar[tuple[str, ...]] = ("test_rotation",)
    cache_settings = ("erp_height",)

    batch_size: PositiveInt = 16
    test_rotation: Literal["yaw", "so3"] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.cache = self.cache or self.root / "spheres"
        self.erp_height: int = self.representation.erp_height
        self.class_names = self.find_classes()  # type: ignore[misc]
        given = self.normalization or SPHERE_NORMALIZATION
        self.normalization = Normalization.of(given, CHANNELS, "data.normalization")

    def find_classes(self) -> tuple[str, ...]:
        """Return the names of the classes, even before the files exist."""
        if not self.root.exists():
            return MODELNET40
        return tuple(sorted({mesh.label for mesh in find_shapes(self.root)}))

    def files(self) -> Mapping[Split, Sequence[ShapeFile]]:
        """See `DataModule`."""
        splits: dict[Split, list[ShapeFile]] = {"train": [], "val": [], "test": []}
        meshes = find_shapes(self.root)
        held: set[str] = set()
        for number, label in enumerate(self.class_names if self.val_fraction else ()):
            names = [m.name for m in meshes if m.label == label and m.part == "train"]
            held |= draw_groups(names, self.val_fraction, (self.seed, number))
        for mesh in meshes:
            splits["val" if mesh.name in held else mesh.part].append(mesh)
        return splits

    def read(self, files: ShapeFile) -> Spheres:
        """See `DataModule`."""
        shape = self.erp_height, 2 * self.erp_height
        values = mesh_spheres(read_mesh(files.path), shape)
        return Spheres(np.rint(values * STEPS).astype(np.uint16))

    def in_parallel(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Generator[Any]:
        """See `DataModule`: in processes, because reading meshes holds the GIL."""
        return in_processes(work, [(item,) for item in items], least=_PER_PROCESS)

    @property
    def in_channels(self) -> int:
        """Number of channels of a sphere."""
        return CHANNELS

    def normalized(self, batch: ShapeSample) -> Tensor:
        """Return the normalized views of a `ShapeSample`, ``(B, N, 6, h, w)`` float32."""
        values = batch.images.movedim(-1, -3).float().contiguous()
        return normalize_channels(values, [STEPS] * CHANNELS, self.normalization)

    def evaluation_size(self) -> int:
        """Shapes per evaluation batch: as many as in training."""
        return self.batch_size
