"""SynthShapes as a data module: that of ModelNet40, after generating the files."""

from __future__ import annotations

from typing import Any

from datamodules.core.data_module import data_set
from datamodules.modelnet40.datamodule import ModelNet40
from datamodules.synthshapes.generate import CLASSES, ShapeSettings, generate_shapes


@data_set
class SynthShapes(ModelNet40):
    """Synthetic shapes, generated on first use and read as ModelNet40: no download.

    Args:
        shapes: Shapes to generate.
    """

    shapes: Any = None

    def __post_init__(self) -> None:
        given = self.shapes or {}
        self.shapes = given if isinstance(given, ShapeSettings) else ShapeSettings(**given)
        super().__post_init__()

    def find_classes(self) -> tuple[str, ...]:
        """Return the names of the ten classes."""
        return CLASSES

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        shapes: Any = self.shapes
        generate_shapes(self.root, shapes)
