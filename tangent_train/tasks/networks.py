"""Networks as configs describe them, and as they are once trained."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from torch import Tensor, nn

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from pathlib import Path

    from datamodules.samples import Input, Normalization

__all__ = [
    "PRETRAINED",
    "Scores",
    "TrainedNetwork",
    "completed_settings",
    "make",
    "make_stored",
    "network_from",
    "size_multiple_of",
]

PRETRAINED = ("weights", "weights_backbone", "encoder_weights")
"""Settings that name trained weights, in models, torchvision and segmentation-models-pytorch."""

_EXTRAS = {"segmentation_models_pytorch": "networks"}
"""Packages of networks that an extra of this one installs."""

_PROBED = {
    1: (127, 131),
    2: (67, 71),
    4: (37, 41),
    8: (17, 19),
    14: (11, 13),
    16: (11, 13),
    32: (5, 7),
    64: (5, 7),
    128: (5, 7),
}
"""What sides may have to be multiples of, and how often they are that when it is tried: primes, so
that they are multiples of nothing else. 14 is for transformers with such patches."""


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network with all that is needed to use it.

    Attributes:
        network: In evaluation mode; ``(B, C, h, w)`` float32, normalized, to scores ``(B, K+1, h,
            w)``, the unknown class first.
        class_names: K + 1 names, the unknown class first.
        inputs: What it is shown, see `datamodules.samples.Input`.
        normalization: Of RGB and depth.
        level: Level s it was trained at.
        representation: The section of the config it was trained with, resolved.
        image_size: Rows and columns of the images that representation evaluates on.
        size_multiple: Height and width of its images must be multiples of this.
        fixed_size: The only rows and columns it takes; None where it takes others.
        settings: The section of the config that makes it, complete; None where only the computation
            is known (ONNX, TorchScript).
    """

    network: nn.Module
    class_names: tuple[str, ...]
    inputs: tuple[Input, ...]
    normalization: Normalization
    level: int
    representation: Mapping[str, Any]
    image_size: tuple[int, int]
    size_multiple: int = 1
    fixed_size: tuple[int, int] | None = None
    settings: Mapping[str, Any] | None = None

    @property
    def in_channels(self) -> int:
        """Channels of its images."""
        from datamodules.samples import channel_names

        return len(channel_names(self.inputs))


class Scores(nn.Module):
    """A network whose result is always a tensor.

    Args:
        network: Maps images ``(B, C, h, w)`` to scores ``(B, K, h, w)``, or to a dict with those
            under ``"out"`` (torchvision's).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Scores of every pixel."""
        scores = self.network(images)
        result: Tensor = scores["out"] if isinstance(scores, dict) else scores
        return result


def make(settings: Mapping[str, Any]) -> Any:
    """What a section of a config describes.

    Args:
        settings: ``_target_`` and its arguments. Whatever it names is called: settings that come
            out of a file are for `stored_settings.check_stored` first.

    Raises:
        DataError: It says itself that a file cannot be used.
        SettingError: It says itself that a setting cannot work.
        InstantiationException: It cannot be made for another reason.
    """
    try:
        return instantiate(dict(settings))
    except InstantiationException as error:
        said = error.__cause__
        if not isinstance(said, DataError | SettingError):
            raise
    raise said  # out here, or the two would be each other's cause


def completed_settings(
    settings: Any, in_channels: int, num_classes: int, *, restored: bool = False
) -> Any:
    """Settings of a network, and of networks inside them, with what the data says where null.

    Args:
        settings: Resolved; ``in_channels``, and ``num_classes`` or ``classes`` may be null.
        in_channels: Channels of the images.
        num_classes: Classes, the unknown one included where there is one.
        restored: Whether a checkpoint will bring the tensors: no others are fetched first.
    """
    known = dict.fromkeys(("num_classes", "classes"), num_classes) | {"in_channels": in_channels}
    unwanted = PRETRAINED if restored else ()

    def complete(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        return {
            name: known.get(name) if inner is None or name in unwanted else complete(inner)
            for name, inner in value.items()
        }

    return complete(settings)


def make_stored(path: Path, section: str, settings: Mapping[str, Any]) -> Any:
    """What a section of the config in a file describes.

    Args:
        path: The file, for the messages.
        section: Name of the section, for the messages.
        settings: ``_target_`` and its arguments.

    Raises:
        DataError: It cannot be made; where a package is missing, which.
    """
    try:
        return make(settings)
    except (DataError, SettingError, InstantiationException) as error:
        package = _missing_package(error)
        if package is None:
            named = isinstance(error, DataError | SettingError)
            cause = error if named else error.__cause__ or error
            first_line = str(cause).partition("\n")[0]
            raise DataError(
                path,
                found=f"a {section} that cannot be made ({first_line})",
                expected=f"settings of {settings.get('_target_')}",
            ) from error
        extra = _EXTRAS.get(package)
        raise DataError(
            path,
            found=f"a {section} of the package {package}, which is not installed",
            expected=f"{settings.get('_target_')}, as in training",
            remedy=f"Run: pip install 'tangent-train[{extra}]'"
            if extra
            else "Install it, or add the folder it is in to PYTHONPATH.",
        ) from error


def network_from(
    path: Path, settings: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> nn.Module:
    """The network that settings describe with the tensors of a file, in evaluation mode.

    Args:
        path: The file, for the messages.
        settings: Complete: ``_target_`` and its arguments.
        tensors: All of its state.

    Returns:
        Its result is always a tensor.

    Raises:
        DataError: It cannot be made, or the tensors are those of another network.
    """
    network: nn.Module = make_stored(path, "network", settings)
    try:
        network.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise DataError(
            path,
            found=f"other tensors than those of its network ({error})",
            expected=f"the tensors of {settings['_target_']}",
            remedy="Is the package of the network of another version than in training?",
        ) from error
    return Scores(network).eval()


def size_multiple_of(network: nn.Module, in_channels: int) -> int | None:
    """What height and width of a network's images must be multiples of, found by trying.

    Args:
        network: In evaluation mode, on the CPU; its result a tensor.
        in_channels: Channels of its images.

    Returns:
        1, 2, 4, 8, 14, 16, 32, 64 or 128; None when it takes no such size.
    """
    shapes_only: nn.Module = copy.deepcopy(network).to("meta")
    found = _least_multiple(shapes_only, in_channels, "meta")
    # Some networks look at values, which there are none of there.
    return found or _least_multiple(network, in_channels, "cpu")


def _least_multiple(network: nn.Module, in_channels: int, device: str) -> int | None:
    for multiple, counts in _PROBED.items():
        rows, columns = (multiple * count for count in counts)
        if _keeps_size(network, torch.zeros(1, in_channels, rows, columns, device=device)):
            return multiple
    return None


@torch.no_grad()
def _keeps_size(network: nn.Module, images: Tensor) -> bool:
    try:
        scores = network(images)
    except Exception:  # each network refuses sizes in its own words
        return False
    return tuple(scores.shape[-2:]) == tuple(images.shape[-2:])


def _missing_package(error: BaseException | None) -> str | None:
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name:
            package = error.name.partition(".")[0]
            return None if find_spec(package) else package
        error = error.__cause__ or error.__context__
    return None
