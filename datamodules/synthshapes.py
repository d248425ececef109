"""SynthShapes: ten classes of shapes made of simple parts, generated in the tree of ModelNet40.

Like models in catalogs, the shapes are open, overlap, and have any scale and origin. They are built
in meters, stand on z = 0 and face +x.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, NonNegativeInt, PositiveInt
from pydantic.dataclasses import dataclass
from trimesh import Trimesh, creation, util
from trimesh.convex import convex_hull
from trimesh.exchange.off import export_off
from trimesh.transformations import rotation_matrix

from datamodules.core.data_module import data_set
from datamodules.modelnet40.shapes import ModelNet40
from datamodules.tables import read_table
from tangent_train.files import write_text
from tangent_train.geometry import rotation_about
from tangent_train.manifest import Manifest
from tangent_train.progress import show_progress

_VERSION = 3  # other versions make other shapes from the same settings


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ShapeSettings:
    """Settings of a data set; the same settings give the same bytes.

    Attributes:
        seed: Seed of everything.
        train: Shapes of every class for training (and validation).
        test: Shapes of every class for the test.
    """

    seed: NonNegativeInt = 0
    train: PositiveInt = 80
    test: PositiveInt = 30


@data_set
class SynthShapes(ModelNet40):
    """Synthetic shapes, generated on first use and read as ModelNet40: no download.

    Args:
        shapes: Shapes to generate.
    """

    shapes: ShapeSettings = field(default_factory=ShapeSettings)

    def find_classes(self) -> tuple[str, ...]:
        """Return the names of the ten classes."""
        return CLASSES

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_shapes(self.root, self.shapes)


def generate_shapes(root: Path, settings: ShapeSettings) -> None:
    """Write a data set in ModelNet40's tree; finished files are kept.

    Args:
        root: Folder of the data set: new, empty, or generated with the same settings.
        settings: Settings of the generator.

    Raises:
        SettingError: The folder holds other files, or shapes of other settings.
    """
    about = {"generator": "SynthShapes", "version": _VERSION}
    manifest = Manifest.open(root, about | asdict(settings), is_shared=True)
    parts = ["train"] * settings.train + ["test"] * settings.test
    shapes = {
        f"{label}/{part}/{label}_{number:04d}.off": (label, number)
        for label in CLASSES
        for number, part in enumerate(parts, start=1)
    }
    missing = manifest.missing(shapes)

    def write(file: str) -> None:
        write_text(root / file, export_off(make_shape(settings.seed, *shapes[file])))
        manifest.finish(file)

    before = len(shapes) - len(missing)
    show_progress(map(write, missing), "Generating shapes", "shapes", len(shapes), before)


def make_shape(seed: int, label: str, number: int) -> Trimesh:
    """Make a shape, the same for the same arguments.

    Args:
        seed: Seed of the data set.
        label: Class.
        number: Index within its class.
    """
    # The name, not its index, so that classes added later do not change the others.
    rng = np.random.default_rng((seed, zlib.crc32(label.encode()), number))
    mesh = util.concatenate(list(_BUILDERS[label](rng)))
    if rng.random() < 0.25:  # an object beside the shape that is not a part of it
        reach = mesh.extents[:2] * 0.6
        place = mesh.bounds.mean(axis=0)[:2] + reach * rng.choice([-1, 1], 2)
        size = rng.uniform(0.1, 0.3, 3) * mesh.extents.max()
        mesh = util.concatenate([mesh, _box((*place, mesh.bounds[0, 2]), size)])
    heading = rotation_about((0, 0, 1), rng.normal(0, 0.12))
    vertices = mesh.vertices * np.exp(rng.normal(0, 0.12, 3)) @ heading.T
    mesh.vertices = (vertices + rng.normal(0, 1, 3) * mesh.extents) * np.exp(rng.uniform(-3, 4))
    return mesh


def _box(center: Any, size: Any) -> Trimesh:
    return creation.box(size).apply_translation(center)


def _rod(start: Any, end: Any, radius: float) -> Trimesh:
    return creation.cylinder(radius, segment=(start, end), sections=12)


def _revolve(*outline: tuple[float, float]) -> Trimesh:
    """Return the surface of revolution of an outline of (radius, height)."""
    return creation.revolve(outline, sections=24)


def _wing(root: Any, tip: Any, chord: float) -> Trimesh:
    """Return a tapered plate from the middle of its root to the middle of its tip."""
    ends = [np.add(root, (x, 0, 0)) for x in (-chord / 2, chord / 2)]
    ends += [np.add(tip, (x, 0, 0)) for x in (-chord / 4, chord / 4)]
    across = np.cross(np.subtract(tip, root), (1, 0, 0))
    across *= chord * 0.04 / np.linalg.norm(across)
    return convex_hull(np.concatenate([ends + across, ends - across]))


def _draw(rng: np.random.Generator, *limits: str) -> list[float]:
    """Draw a number between each pair of limits."""
    numbers = list(map(float, " ".join(limits).replace(";", " ").split()))
    return [rng.uniform(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]


def _seat(rng: np.random.Generator, row: dict[str, str]) -> Iterator[Trimesh]:
    """Yield a top on four legs or a pedestal, perhaps with a back and arms."""
    between = rng.uniform
    names = ("width", "depth", "height", "thick")
    width, depth, height, thick = _draw(rng, *(row[name] for name in names))
    inner = 0.8
    if rng.random() < float(row["round_top"]):
        low, edge = height - thick, width / 2
        yield _revolve((0, low), (edge, low), (edge, height), (0, height))
        depth, inner = width, 0.6
    else:
        yield _box((0, 0, height - thick / 2), (depth, width, thick))
    if rng.random() < float(row["pedestal"]):
        yield _rod((0, 0, 0), (0, 0, height), between(0.02, 0.06))
        yield _revolve((0, 0), (width * between(0.25, 0.5), 0), (0, 0.05))
    else:
        radius, splay = between(0.012, 0.035), between(0.9, 1.2)
        for x, y in product((-1, 1), repeat=2):
            top = np.array([x * depth, y * width, 0]) * inner / 2
            yield _rod(top * splay, np.add(top, (0, 0, height - thick / 2)), radius)
    if rng.random() < float(row["back"]):
        (high,) = _draw(rng, row["back_height"])
        yield _box((-depth / 2, 0, height + high / 2), (between(0.02, 0.08), width, high))
    if rng.random() < float(row["arms"]):
        for side in (-1, 1):
            edge, rise = side * width / 2, between(0.14, 0.26)
            yield _box((0, edge, height + rise), (depth * between(0.6, 1), 0.05, 0.03))
            foot, ahead = height - thick, depth * 0.3
            yield _rod((ahead, edge, foot), (ahead, edge, height + rise), 0.02)


def _vessel(rng: np.random.Generator, row: dict[str, str]) -> Iterator[Trimesh]:
    """Yield a surface of revolution, with a wall or closed, and perhaps a handle."""
    height, share = _draw(rng, row["height"], row["radius"])
    radius = height * share
    points = _draw(rng, row["outline"])
    outline = [(radius * r, height * z) for z, r in zip(points[::2], points[1::2], strict=True)]
    if rng.random() < float(row["open"]):
        wall = radius * rng.uniform(0.04, 0.12)
        inside = [(max(r - wall, 0.001), max(z, wall)) for r, z in reversed(outline)]
        yield _revolve((0, 0), *outline, *inside, (0, wall))
    else:
        yield _revolve((0, 0), *outline, (0, height))
    if rng.random() < float(row["handle"]):
        size = height * rng.uniform(0.15, 0.35)
        ring = creation.torus(size, size * 0.18, major_sections=20, minor_sections=8)
        ring.apply_transform(rotation_matrix(np.pi / 2, (1, 0, 0)))
        yield ring.apply_translation((radius * 0.9, 0, height / 2))


def _lamp(rng: np.random.Generator) -> Iterator[Trimesh]:
    """Yield a foot, a pole, straight or bent, and a shade."""
    between = rng.uniform
    height = between(0.3, 1.7)
    base, thick = height * between(0.1, 0.24), height * between(0.008, 0.03)
    yield _revolve((0, 0), (base, 0), (base * between(0.5, 1), 0.04), (0, 0.05))
    x = height * between(0.2, 0.5) if rng.random() < 0.3 else 0.0
    elbow = (-0.3 * x, 0, height * between(0.4, 0.9))
    yield _rod((0, 0, 0), elbow, thick)
    yield _rod(elbow, (x, 0, height), thick)
    wide, low = height * between(0.1, 0.28), height * between(0.12, 0.3)
    shade = _revolve((wide, height - low), (wide * between(0.3, 1), height), (0, height))
    yield shade.apply_translation((x, 0, 0))


def _airplane(rng: np.random.Generator) -> Iterator[Trimesh]:
    """Yield a fuselage, two pairs of wings, a fin, and perhaps engines."""
    between = rng.uniform
    length = between(8, 40)
    radius = length * between(0.035, 0.075)
    yield creation.icosphere(subdivisions=2).apply_scale((length / 2, radius, radius))
    span, chord = length * between(0.3, 0.75), length * between(0.1, 0.28)
    sweep, z = length * between(-0.05, 0.25), radius * between(-0.7, 0.8)
    tail, rear = length * between(0.08, 0.2), -length * between(0.38, 0.45)
    for side in (-1, 1):
        yield _wing((0, 0, z), (-sweep, side * span, z), chord)
        yield _wing((rear, 0, z / 2), (rear - tail * 0.4, side * tail, z / 2), tail * 0.6)
    yield _wing((rear, 0, 0), (rear - tail * 0.4, 0, tail * 1.1), tail * 0.6)
    for k in range(int(rng.integers(0, 3))):
        share, size = 0.35 + 0.3 * k, radius * between(0.3, 0.55)
        for side in (-1, 1):
            start = np.array([-sweep * share, side * span * share, z - size])
            yield _rod(start, np.add(start, (chord * 0.8, 0, 0)), size)


_BUILDERS: dict[str, Callable[[np.random.Generator], Iterator[Trimesh]]] = {
    "airplane": _airplane,
    "lamp": _lamp,
    # Limits of sizes in meters; shares of round tops, pedestals, backs and arms.
    **{row["class"]: partial(_seat, row=row) for row in read_table("synthshapes_seats")},
    # Limits of the height, of the radius relative to it, and of the points of the outline, which
    # have limits of height and radius, relative to the vessel's. Shares of open ones and handles.
    **{row["class"]: partial(_vessel, row=row) for row in read_table("synthshapes_vessels")},
}

CLASSES = tuple(sorted(_BUILDERS))
"""Names of the classes, in alphabetical order."""
