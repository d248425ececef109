"""SynthShapes: ten classes of shapes made of simple parts, generated in the tree of ModelNet40.

Like models in catalogs, the shapes are open, overlap, and have any scale and origin. They are built
in meters, stand on z = 0 and face +x.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import asdict, field
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
_SEATS = {row["class"]: row for row in read_table("synthshapes_seats")}
"""Limits of sizes in meters; shares of round tops, pedestals, backs and arms."""

_VESSELS = {row["class"]: row for row in read_table("synthshapes_vessels")}
"""Limits of the height, of the radius relative to it, and of the points of the outline.

Points have limits of height and radius, relative to those of the vessel. Shares of open vessels
and handles.
"""

CLASSES = tuple(sorted([*_SEATS, *_VESSELS, "airplane", "lamp"]))
"""Names of the classes, in alphabetical order."""


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

    def write() -> Iterator[None]:
        for file in missing:
            write_text(root / file, export_off(make_shape(settings.seed, *shapes[file])))
            manifest.finish(file)
            yield

    show_progress(write(), "Generating shapes", "shapes", len(shapes), len(shapes) - len(missing))


def make_shape(seed: int, label: str, number: int) -> Trimesh:
    """Make a shape, the same for the same arguments.

    Args:
        seed: Seed of the data set.
        label: Class.
        number: Index within its class.
    """
    # The name, not its index, so that classes added later do not change the others.
    rng = np.random.default_rng((seed, zlib.crc32(label.encode()), number))
    shape = _Shape(rng)
    shape.build(label)
    mesh = util.concatenate(shape.pieces)
    if rng.random() < 0.25:  # an object beside the shape that is not a part of it
        reach = mesh.extents[:2] * 0.6
        place = mesh.bounds.mean(axis=0)[:2] + reach * rng.choice([-1, 1], 2)
        shape.box((*place, mesh.bounds[0, 2]), rng.uniform(0.1, 0.3, 3) * mesh.extents.max())
        mesh = util.concatenate(shape.pieces)
    heading = rotation_about((0, 0, 1), rng.normal(0, 0.12))
    vertices = mesh.vertices * np.exp(rng.normal(0, 0.12, 3)) @ heading.T
    mesh.vertices = (vertices + rng.normal(0, 1, 3) * mesh.extents) * np.exp(rng.uniform(-3, 4))
    return mesh


class _Shape:
    """A shape under construction."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.pieces: list[Trimesh] = []
        self._between, self._rng = rng.uniform, rng

    def build(self, label: str) -> None:
        """Add the pieces of a class."""
        if label in _SEATS:
            self._build_seat(_SEATS[label])
        elif label in _VESSELS:
            self._build_vessel(_VESSELS[label])
        elif label == "lamp":
            self._build_lamp()
        else:
            self._build_airplane()

    def _chance(self, share: float | str) -> bool:
        return bool(self._rng.random() < float(share))

    def box(self, center: Any, size: Any) -> None:
        """Add a box."""
        self.pieces.append(creation.box(size).apply_translation(center))

    def _rod(self, start: Any, end: Any, radius: float) -> None:
        self.pieces.append(creation.cylinder(radius, segment=(start, end), sections=12))

    def _revolve(self, outline: Any) -> None:
        """Add the surface of revolution of an outline of (radius, height)."""
        self.pieces.append(creation.revolve(outline, sections=24))

    def _draw(self, limits: str) -> list[float]:
        """Draw a number between each pair of limits."""
        numbers = list(map(float, limits.replace(";", " ").split()))
        return [self._between(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]

    def _build_seat(self, row: dict[str, str]) -> None:
        """Add a top on four legs or a pedestal, perhaps with a back and arms."""
        between = self._between
        sizes = " ".join(row[name] for name in ("width", "depth", "height", "thick"))
        width, depth, height, thick = self._draw(sizes)
        inner = 0.8
        if self._chance(row["round_top"]):
            self._revolve(
                [(0, height - thick), (width / 2, height - thick), (width / 2, height), (0, height)]
            )
            depth, inner = width, 0.6
        else:
            self.box((0, 0, height - thick / 2), (depth, width, thick))
        if self._chance(row["pedestal"]):
            self._rod((0, 0, 0), (0, 0, height), between(0.02, 0.06))
            self._revolve([(0, 0), (width * between(0.25, 0.5), 0), (0, 0.05)])
        else:
            radius, splay = between(0.012, 0.035), between(0.9, 1.2)
            for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                top = np.array([x * depth, y * width, 0]) * inner / 2
                self._rod(top * splay, np.add(top, (0, 0, height - thick / 2)), radius)
        if self._chance(row["back"]):
            (high,) = self._draw(row["back_height"])
            self.box((-depth / 2, 0, height + high / 2), (between(0.02, 0.08), width, high))
        if self._chance(row["arms"]):
            for side in (-1, 1):
                edge, rise = side * width / 2, between(0.14, 0.26)
                self.box((0, edge, height + rise), (depth * between(0.6, 1), 0.05, 0.03))
                self._rod(
                    (depth * 0.3, edge, height - thick), (depth * 0.3, edge, height + rise), 0.02
                )

    def _build_vessel(self, row: dict[str, str]) -> None:
        """Add a surface of revolution, with a wall or closed, perhaps with a handle."""
        height, share = self._draw(f"{row['height']} {row['radius']}")
        radius = height * share
        points = self._draw(row["outline"])
        outline = [(radius * r, height * z) for z, r in zip(points[::2], points[1::2], strict=True)]
        if self._chance(row["open"]):
            wall = radius * self._between(0.04, 0.12)
            inside = [(max(r - wall, 0.001), max(z, wall)) for r, z in reversed(outline)]
            self._revolve([(0, 0), *outline, *inside, (0, wall)])
        else:
            self._revolve([(0, 0), *outline, (0, height)])
        if self._chance(row["handle"]):
            size = height * self._between(0.15, 0.35)
            ring = creation.torus(size, size * 0.18, major_sections=20, minor_sections=8)
            ring.apply_transform(rotation_matrix(np.pi / 2, (1, 0, 0)))
            self.pieces.append(ring.apply_translation((radius * 0.9, 0, height / 2)))

    def _build_lamp(self) -> None:
        """Add a foot, a pole, straight or bent, and a shade."""
        between = self._between
        height = between(0.3, 1.7)
        base, thick = height * between(0.1, 0.24), height * between(0.008, 0.03)
        self._revolve([(0, 0), (base, 0), (base * between(0.5, 1), 0.04), (0, 0.05)])
        x = height * between(0.2, 0.5) if self._chance(0.3) else 0.0
        elbow = (-0.3 * x, 0, height * between(0.4, 0.9))
        self._rod((0, 0, 0), elbow, thick)
        self._rod(elbow, (x, 0, height), thick)
        wide, low = height * between(0.1, 0.28), height * between(0.12, 0.3)
        shade = np.array([(wide, height - low), (wide * between(0.3, 1), height), (0, height)])
        self.pieces.append(creation.revolve(shade, sections=24).apply_translation((x, 0, 0)))

    def _build_airplane(self) -> None:
        """Add a fuselage, two pairs of wings, a fin, and perhaps engines."""
        between = self._between
        length = between(8, 40)
        radius = length * between(0.035, 0.075)
        fuselage = creation.icosphere(subdivisions=2).apply_scale((length / 2, radius, radius))
        self.pieces.append(fuselage)
        span, chord = length * between(0.3, 0.75), length * between(0.1, 0.28)
        sweep, z = length * between(-0.05, 0.25), radius * between(-0.7, 0.8)
        tail, rear = length * between(0.08, 0.2), -length * between(0.38, 0.45)
        for side in (-1, 1):
            self._add_wing((0, 0, z), (-sweep, side * span, z), chord)
            self._add_wing((rear, 0, z / 2), (rear - tail * 0.4, side * tail, z / 2), tail * 0.6)
        self._add_wing((rear, 0, 0), (rear - tail * 0.4, 0, tail * 1.1), tail * 0.6)
        for k in range(int(self._rng.integers(0, 3))):
            share, size = 0.35 + 0.3 * k, radius * between(0.3, 0.55)
            for side in (-1, 1):
                start = np.array([-sweep * share, side * span * share, z - size])
                self._rod(start, np.add(start, (chord * 0.8, 0, 0)), size)

    def _add_wing(self, root: Any, tip: Any, chord: float) -> None:
        """Add a tapered plate from the middle of its root to the middle of its tip."""
        ends = [np.add(root, (x, 0, 0)) for x in (-chord / 2, chord / 2)]
        ends += [np.add(tip, (x, 0, 0)) for x in (-chord / 4, chord / 4)]
        across = np.cross(np.subtract(tip, root), (1, 0, 0))
        across *= chord * 0.04 / np.linalg.norm(across)
        self.pieces.append(convex_hull(np.concatenate([ends + across, ends - across])))
