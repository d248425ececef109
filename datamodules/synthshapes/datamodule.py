"""SynthShapes as a data module: that of ModelNet40, after generating the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from datamodules.modelnet40.datamodule import ModelNet40
from datamodules.synthshapes.generate import CLASSES, ShapeSettings, generate_shapes


@dataclass(kw_only=True, eq=False, repr=False)
class SynthShapes(ModelNet40):
    """Synthetic shapes, generated on first use and read as ModelNet40: no download.

    Args:
        shapes: Shapes to generate.

    Raises:
        SettingError: A setting is invalid.
    """

    shapes: ShapeSettings | Mapping[str, int] | None = None

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
