"""``tangent-export``: write a trained network for other programs."""

from __future__ import annotations

from rich import get_console
from rich.text import Text

from tangent_train.checkpoints.loaded import load_network
from tangent_train.cli import main
from tangent_train.config.settings import ExportSettings
from tangent_train.console import print_text
from tangent_train.errors import printable, width_height
from tangent_train.files import check_new
from tangent_train.inference.export import export_network


def export(settings: ExportSettings) -> None:
    """Write a trained network to a file, and print the largest difference from PyTorch's scores.

    Raises:
        DataError: The checkpoint cannot be used.
        SettingError: The file exists, or the network cannot be exported.
    """
    output = settings.output
    check_new(output, overwrite=settings.overwrite)
    with get_console().status(Text(f"Writing {printable(output.name)} …")):
        loaded = load_network(settings.checkpoint, settings.trust)
        size, opset = settings.image_size, settings.opset
        written = export_network(loaded, output, image_size=size, opset=opset)
    fixed, multiple = written.loaded.fixed_size, loaded.size_multiple
    sides = width_height(fixed) if fixed else "any size"
    sides += f", multiples of {multiple}" if multiple > 1 and not fixed else ""
    scores, of_what = f"scores: {loaded.network.num_outputs} classes", "scores"
    if loaded.depth_kind is not None:
        scores, of_what = f"depth: {loaded.depth_kind}", "depth"
    print_text(
        f"{output}: {output.stat().st_size / 1e6:.1f} MB\n"
        f"images: {loaded.in_channels} channels, {sides}; {scores}\n"
        f"largest difference from PyTorch: {written.difference:.1e} of the range of the {of_what}"
    )


if __name__ == "__main__":
    main.export()
