"""SynthShapes: ten families of shapes, generated in the tree of ModelNet40."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from trimesh import Trimesh
from trimesh.exchange.off import export_off

from datamodules.core.made_folders import claim_folder
from datamodules.core.processes import in_processes
from datamodules.synthshapes import furniture, vessels
from datamodules.synthshapes.parts import Parts
from tangent_train.errors import at_least
from tangent_train.files import write_text
from tangent_train.geometry import rotation_about
from tangent_train.progress import show_progress

MANIFEST = "synthshapes.json"
"""File that marks a folder as SynthShapes and holds its settings."""

_VERSION = 2
_PER_PROCESS = 200
_FAMILIES: dict[str, Callable[[Parts], None]] = {
    "airplane": vessels.airplane,
    "bench": furniture.bench,
    "bottle": vessels.bottle,
    "bowl": vessels.bowl,
    "chair": furniture.chair,
    "cup": vessels.cup,
    "lamp": furniture.lamp,
    "stool": furniture.stool,
    "table": furniture.table,
    "vase": vessels.vase,
}

CLASSES = tuple(_FAMILIES)
"""Names of the classes, in alphabetical order."""


@dataclass(frozen=True)
class ShapeSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything, 0 or more.
        train: Shapes of every class for training (and validation).
        test: Shapes of every class for the test.

    Raises:
        SettingError: A setting is invalid.
    """

    seed: int = 0
    train: int = 80
    test: int = 30

    def __post_init__(self) -> None:
        at_least("data.shapes.seed", self.seed, 0)
        at_least("data.shapes.train", self.train, 1)
        at_least("data.shapes.test", self.test, 1)


def plan_shapes(settings: ShapeSettings) -> dict[str, tuple[str, int]]:
    """Return class and number of every shape by its file, test shapes last."""
    parts = ["train"] * settings.train + ["test"] * settings.test
    return {
        f"{label}/{part}/{label}_{number:04d}.off": (label, number)
        for label in CLASSES
        for number, part in enumerate(parts, start=1)
    }


def generate_shapes(root: Path, settings: ShapeSettings, *, workers: int | None = None) -> None:
    """Write a data set in ModelNet40's tree; finished files are kept.

    The same settings give the same bytes for any number of workers, whether or not the work was
    interrupted.

    Args:
        root: Folder of the data set: new, empty, or generated with the same settings.
        settings: Settings of the generator.
        workers: Number of processes, by default one per CPU core, fewer for little work; 0 and 1
            mean this process.

    Raises:
        DataError: The folder holds other files, or shapes of other settings; nothing is written.
    """
    plans = plan_shapes(settings)
    claim_folder(root, MANIFEST, "SynthShapes", _VERSION, asdict(settings))
    missing = [file for file in plans if not (root / file).exists()]
    pieces = [(root / file, settings.seed, *plans[file]) for file in missing]
    making = in_processes(_write, pieces, workers, _PER_PROCESS)
    before = len(plans) - len(missing)
    show_progress(making, "Generating shapes", "shapes", len(plans), before)


def _write(path: Path, seed: int, label: str, number: int) -> None:
    write_text(path, export_off(make_shape(seed, label, number)))


def make_shape(seed: int, label: str, number: int) -> Trimesh:
    """Make a shape, the same for the same arguments.

    Like models in catalogs, each shape has a different scale and origin, and roughly the heading of
    its class.

    Args:
        seed: Seed of the data set.
        label: Class.
        number: Index within its class.
    """
    # The name, not its index, so that classes added later do not change the others.
    rng = np.random.default_rng((seed, zlib.crc32(label.encode()), number))
    parts = Parts(rng)
    _FAMILIES[label](parts)
    if parts.chance(0.25):
        _put_beside(parts)
    mesh = parts.mesh()
    vertices = mesh.vertices
    # Stretched, and tapered a little towards the top or the bottom.
    size = vertices.max(axis=0) - vertices.min(axis=0)
    stretch = np.exp(rng.normal(0, 0.12, 3))
    share = (vertices[:, 2:] - vertices[:, 2:].min()) / size[2] - 0.5
    taper = 1 + rng.normal(0, 0.08) * share
    vertices = vertices * stretch * np.concatenate([taper, taper, np.ones_like(taper)], axis=1)
    heading = rotation_about((0, 0, 1), rng.normal(0, 0.12))
    unit, origin = np.exp(rng.uniform(-3, 4)), rng.normal(0, 1, 3)
    mesh.vertices = (vertices @ heading.T + origin * size) * unit
    return mesh


def _put_beside(parts: Parts) -> None:
    """Put an object next to the shape that is not a part of it."""
    low, high = parts.mesh().bounds
    size = float(np.max(high - low)) * parts.between(0.06, 0.2)
    angle = parts.between(0, 2 * np.pi)
    reach = (high - low)[:2] / 2 + size
    x, y = (low + high)[:2] / 2 + reach * (np.cos(angle), np.sin(angle))
    center = (float(x), float(y), float(low[2]) + size)
    if parts.chance(0.5):
        parts.ellipsoid(center, (size, size, size))
    else:
        parts.box(center, [2 * size] * 3, rotation_about((0, 0, 1), angle))
