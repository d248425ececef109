"""``tangent-import``: a photo network as a checkpoint that every command takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf
from rich import get_console
from rich.text import Text

from tangent_train.checkpoints.kinds import DepthKind, ScoreKind
from tangent_train.cli.command_settings import ImportSettings
from tangent_train.cli.settings import check_new, check_unread, parse_settings
from tangent_train.console import print_text
from tangent_train.errors import SettingError, printable, width_height
from tangent_train.imports import elsewhere

if TYPE_CHECKING:
    from tangent_train.checkpoints.loaded import LoadedNetwork
    from tangent_train.photo_networks import PhotoNetwork


_OF_LIBRARIES = ("model", "weights", "file", "classes", "depth")
"""Settings that only some of the functions `load` take."""

_LIBRARIES = ("torchvision", "huggingface", "smp")
"""Each a file of `tangent_train.photo_networks` with a function `load`."""


_OUTPUTS: dict[ScoreKind | DepthKind, str] = {
    "logits": "scores before a softmax",
    "probabilities": "probabilities after a softmax",
    "labels": "label maps, of which other values are unknown",
    "log_distance": "the logarithm of the distance in meters",
    "metric_distance": "the distance along each ray in meters",
    "metric_z": "z-depth in meters",
    "canonical_inverse": "1 / z-depth in meters, times the focal length of a view in widths",
    "relative_depth": "z-depth up to a scale and a shift of each view",
    "relative_disparity": "1 / z-depth up to a scale and a shift of each view",
}

_OF_CLASSES = {"classes": None, "unknown_classes": (), "unknown_wins": True, "scores": None}
"""Settings that depth networks do not have, and their defaults."""


def import_network(config: Mapping[str, Any]) -> None:
    """Write a photo network as a checkpoint and print what was understood.

    Args:
        config: The composed ``import.yaml``.

    Raises:
        DataError: A file cannot be used.
        SettingError: A setting is missing or impossible, or the file exists.
    """
    settings = parse_settings(ImportSettings, config)
    output = settings.output
    with elsewhere():
        from tangent_train import photo_networks

    suffix = ".onnx" if settings.network == "onnx" else ".ckpt"
    if output.suffix.lower() != suffix:
        raise SettingError("output", found=output.name, expected=f"a name ending in {suffix}")
    check_new(settings, output)
    with get_console().status(Text(f"Writing {printable(output.name)} …")):
        network = _load(settings, config["normalization"])
        if network.depth_kind is None:
            check_unread(settings, "for networks of classes", depth=None)
        else:
            check_unread(settings, "for depth networks", **_OF_CLASSES)
        trained = photo_networks.import_network(
            network,
            output,
            fov_deg=settings.fov,
            levels=settings.levels,
            base_level=settings.base_level,
            views=settings.views,
            unknown_classes=settings.unknown_classes,
            unknown_wins=settings.unknown_wins,
            image_size=_rows_and_columns(settings.image_size),
            score_kind=settings.scores,
        )
    print_text(_understood(output, trained, settings))


def _rows_and_columns(given: tuple[int, ...] | None) -> tuple[int, int] | None:
    """A size of images; one number is that of a square."""
    if given is None:
        return None
    if len(given) not in (1, 2) or min(given) < 1:
        raise SettingError(
            "image_size", found=list(given), expected="[rows,columns], or the side of a square"
        )
    return given[0], given[-1]


def _load(settings: ImportSettings, normalization: Any) -> PhotoNetwork:
    """The network, from the library that the settings name."""
    with elsewhere():
        from tangent_train.photo_networks import own_files

        name = settings.network
        load: Callable[..., PhotoNetwork] = own_files.load_onnx
        if name in _LIBRARIES:
            load = import_module(f"tangent_train.photo_networks.{name}").load
    if name not in (*_LIBRARIES, "onnx"):
        try:
            config: Any = compose("import", [f"+network@section={name}"])
        except MissingConfigException as error:
            known = ", ".join((*_LIBRARIES, "onnx", *(error.options or ())))
            raise SettingError("network", found=name, expected=f"of {known}") from error
        section: Any = OmegaConf.to_container(config.section)
        load = partial(own_files.load_config, section)
    read = signature(load).parameters
    unread = dict.fromkeys(name for name in _OF_LIBRARIES if name not in read)
    check_unread(settings, f"for network={name}", **unread)
    given = {name: getattr(settings, name) for name in _OF_LIBRARIES if name in read}
    return load(**given, normalization=normalization)


def _understood(path: Path, trained: LoadedNetwork, settings: ImportSettings) -> str:
    """Description of an imported network."""
    from tangent_train.inference.representations import PanoramaViews

    names = trained.class_names[1:]
    mean, std = trained.normalization.mean, trained.normalization.std
    numbers = [" ".join(f"{value:.4g}" for value in values) for values in (mean, std)]
    size = width_height(trained.fixed_size) if trained.fixed_size else "any"
    multiple = f", multiples of {trained.size_multiple}" if trained.size_multiple > 1 else ""
    kind = trained.depth_kind
    lines = [
        f"{path}: {path.stat().st_size / 1e6:.1f} MB",
        f"{len(names)} classes: {', '.join(names)}" if kind is None else f"depth: {kind}",
        f"the network returns {_OUTPUTS[kind or trained.score_kind]}",
        f"normalization of images from 0 to 1: mean {numbers[0]}, std {numbers[1]}",
        f"image size: {size}{multiple}",
        f"panoramas: {PanoramaViews(trained).description()}",
    ]
    if trained.trust:
        trust = ",".join(trained.trust)
        lines.append(f"your own network: every command that reads it needs trust=[{trust}]")
    if settings.unknown_classes:
        effect = "written as unknown" if settings.unknown_wins else "never win"
        lines.insert(2, f"{', '.join(settings.unknown_classes)}: {effect}")
    return "\n".join(lines)
