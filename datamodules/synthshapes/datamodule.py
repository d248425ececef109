"""SynthShapes as a data module: ModelNet40's own, after generating the files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from datamodules.modelnet40.datamodule import ModelNet40
from datamodules.synthshapes.generate import CLASSES, ShapeSettings, generate_shapes
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["SynthShapes"]


@registered
class SynthShapes(ModelNet40):
    """Synthetic shapes, generated on first use and read as ModelNet40: no download.

    Args:
        root: Folder for the files.
        representation: What the network sees of a sphere.
        shapes: Which shapes to generate.
        **settings: All others of `ModelNet40`.

    Raises:
        SettingError: A setting that cannot work.
    """

    is_made = True

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        shapes: ShapeSettings | Mapping[str, int] | None = None,
        **settings: Any,
    ) -> None:
        given = shapes or {}
        self.shapes = given if isinstance(given, ShapeSettings) else ShapeSettings(**given)
        super().__init__(root, representation, **settings)

    def find_classes(self) -> tuple[str, ...]:
        """The names of the ten classes."""
        return CLASSES

    def make_files(self) -> None:
        """Generate the files, unless they are there."""
        generate_shapes(self.root, self.shapes)
