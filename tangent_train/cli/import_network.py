"""``tangent-import``: a photo network as a checkpoint that every command takes."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING

from rich import get_console
from rich.text import Text

from tangent_train.cli import main
from tangent_train.config.settings import ImportSettings, check_read
from tangent_train.console import print_text
from tangent_train.errors import SettingError, listed, printable, width_height
from tangent_train.files import check_new

if TYPE_CHECKING:
    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.photo_networks import PhotoNetwork


_OF_CLASSES = {"unknown_classes", "unknown_wins", "scores"}
"""Settings that only networks of classes have."""

_READ = {
    *("library", "network", "normalization", "image_size", "views", "levels", "base_level", "fov"),
    *("output", "overwrite"),
}
"""Settings that all networks have."""


def import_network(settings: ImportSettings) -> None:
    """Write a photo network as a checkpoint and print what was understood.

    Args:
        settings: Settings of the command.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing or impossible, or the file exists.
    """
    from tangent_train import photo_networks

    output, size = settings.output, settings.image_size
    suffix = ".onnx" if settings.library == "onnx" else ".ckpt"
    if output.suffix.lower() != suffix:
        remedy = "An ONNX network stays an ONNX file." if suffix == ".onnx" else ""
        expected = f"a name ending in {suffix}"
        raise SettingError("output", found=output.name, expected=expected, remedy=remedy)
    check_new(output, overwrite=settings.overwrite)
    with get_console().status(Text(f"Writing {printable(output.name)} …")):
        network = _load(settings)
        trained = photo_networks.import_network(
            network,
            output,
            fov_deg=settings.fov,
            levels=settings.levels,
            base_level=settings.base_level,
            views=settings.views,
            unknown_classes=settings.unknown_classes,
            unknown_wins=settings.unknown_wins,
            image_size=None if size is None else (size[0], size[-1]),
            score_kind=settings.scores,
        )
    print_text(_understood(output, trained, settings))


def _load(settings: ImportSettings) -> PhotoNetwork:
    """Return the network, from the library or the option that the settings name."""
    from tangent_train.photo_networks.libraries import LOADERS

    load = LOADERS[settings.library]
    given = {name: getattr(settings, name) for name in signature(load).parameters}
    needed = next(iter(given))
    if given[needed] is None:
        expected = f"a value, for library={settings.library or 'null'}"
        raise SettingError(needed, found="null", expected=expected)
    network = load(**given)
    unread = set[str]() if settings.prompts is None else {"classes", "depth", "things"}
    unread |= {"threshold"} - (network.settings or {}).keys()
    read = (_READ | given.keys()) - unread
    check_read(settings, (read | _OF_CLASSES) if network.depth_kind is None else read - {"classes"})
    return network


def _camera(trained: LoadedNetwork) -> str:
    """Description of the camera that a network is right for."""
    if trained.photo_fov_deg is not None:
        across, down = trained.photo_fov_deg
        return f"{across:.4g}° × {down:.4g}°"
    from tangent_train.photo_networks.importing import USUAL_FOV_DEG

    return f"assumed {USUAL_FOV_DEG:g}° wide; fov=[horizontal,vertical] states another camera"


def _understood(path: Path, trained: LoadedNetwork, settings: ImportSettings) -> str:
    """Description of an imported network."""
    from tangent_train.inference.views import ViewSelector

    names, kind = trained.class_names[1:], trained.depth_kind
    mean, std = (
        " ".join(f"{value:.4g}" for value in values)
        for values in (trained.normalization.mean, trained.normalization.std)
    )
    size = width_height(trained.fixed_size) if trained.fixed_size else "any"
    multiple = f", multiples of {trained.size_multiple}" if trained.size_multiple > 1 else ""
    effect = "written as unknown" if settings.unknown_wins else "never win"
    trust = f"your own network: commands that read it need trust=[{','.join(trained.trust)}]"
    unknown = f"{', '.join(settings.unknown_classes)}: {effect}"
    return "\n".join(
        [
            f"{path}: {path.stat().st_size / 1e6:.1f} MB",
            *[f"{len(names)} classes: {listed(names)}"] * (kind is None),
            *[f"objects of: {listed(trained.things)}"] * bool(trained.things),
            *[unknown] * bool(settings.unknown_classes),
            f"the network returns {kind or trained.score_kind}",
            f"normalization of images from 0 to 1: mean {mean}, std {std}",
            f"image size: {size}{multiple}",
            f"photos of its training: {_camera(trained)}",
            f"panoramas: {ViewSelector(trained).description()}",
            *[trust] * bool(trained.trust),
        ]
    )


if __name__ == "__main__":
    main.import_network()
