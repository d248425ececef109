"""`tangent-export`: a trained network for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from models.held import held_networks
from models.sphere_context import SphereContext
from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli import values
from tangent_train.errors import SettingError
from tangent_train.inference.export import SUFFIXES, Export, Format, export_network

__all__ = ["export"]

_EXAMPLE = "For example: tangent-export checkpoint=runs/…/checkpoints/best.ckpt output=model.onnx"


def export(settings: Mapping[str, Any]) -> None:
    """Write a trained network to a file and say how well it agrees with PyTorch.

    Args:
        settings: The composed ``export.yaml``.

    Raises:
        DataError: The checkpoint cannot be used.
        SettingError: A setting is missing or impossible, the file is there already, or the network
            cannot be exported.
    """
    checkpoint = _given(settings, "checkpoint", "a checkpoint written by tangent-train")
    output = _given(settings, "output", f"a file ending in {', '.join(SUFFIXES.values())}")
    form = _format(settings["format"], output)
    size, opset = _image_size(settings["image_size"]), _opset(settings["opset"])
    if output.exists() and (output.is_dir() or not values.flag(settings, "overwrite")):
        raise SettingError(
            "output",
            found=f"{output}, which exists",
            expected="a new file",
            remedy="" if output.is_dir() else "Give another name, or set overwrite=true.",
        )
    console = Console(soft_wrap=True, highlight=False)
    with console.status(f"Writing {output.name} …"):
        trained = load_trained(checkpoint, values.names(settings, "trust"))
        written = export_network(trained, output, form, image_size=size, opset=opset)
    console.print(_summary(written, output))
    held = held_networks(getattr(trained.network, "network", trained.network))  # in `Scores`
    if form != "safetensors" and any(isinstance(network, SphereContext) for network in held):
        console.print(
            f"In {output.name} every image is alone: the images of a sphere do not see each other. "
            "With the checkpoint or format=safetensors they do."
        )


def _given(settings: Mapping[str, Any], name: str, expected: str) -> Path:
    if not settings[name]:
        raise SettingError(name, found="none", expected=expected, remedy=_EXAMPLE)
    return Path(str(settings[name])).expanduser()


def _format(given: str | None, output: Path) -> Format:
    if given in SUFFIXES:
        return given
    forms = {suffix: form for form, suffix in SUFFIXES.items()}
    suffix = output.suffix.lower()
    if given is not None:
        raise SettingError("format", found=given, expected=" or ".join(SUFFIXES))
    if suffix not in forms:
        raise SettingError(
            "output", found=output.name, expected=f"a name ending in {', '.join(forms)}"
        )
    return forms[suffix]


def _image_size(given: Any) -> tuple[int, int] | None:
    if given is None:
        return None
    sides = given if isinstance(given, Sequence) and not isinstance(given, str) else []
    if len(sides) != 2 or not all(isinstance(side, int) for side in sides):
        raise SettingError("image_size", found=given, expected="[height, width] or null")
    return sides[0], sides[1]


def _opset(given: Any) -> int | None:
    if given is not None and not isinstance(given, int):
        raise SettingError("opset", found=given, expected="a whole number or null")
    return given


def _summary(written: Export, output: Path) -> str:
    trained = written.trained
    channels, classes = trained.in_channels, len(trained.class_names)
    if trained.fixed_size is not None:
        sides = "×".join(map(str, trained.fixed_size))
    elif trained.size_multiple > 1:
        sides = f"h×w, both multiples of {trained.size_multiple}"
    else:
        sides = "h×w"
    return (
        f"{output}: {output.stat().st_size / 1e6:.1f} MB\n"
        f"images: any number of {channels} channels, {sides}; scores of {classes} classes\n"
        f"largest difference to PyTorch: {written.difference:.1e}, "
        f"{written.share:.1e} of the range of the scores"
    )
