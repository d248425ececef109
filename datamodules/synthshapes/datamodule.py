"""SynthShapes as a data module: that of ModelNet40, after generating the files."""

from __future__ import annotations

from dataclasses import field

from datamodules.core.data_module import data_set
from datamodules.modelnet40.shapes import ModelNet40
from datamodules.synthshapes.generate import CLASSES, ShapeSettings, generate_shapes


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
