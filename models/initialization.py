"""Initialization of a network from trained tensors of another network."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor, nn

from models.pretrained import tensors_for
from models.stem import select_channels
from tangent_train.errors import DataError, printable


class Origins(NamedTuple):
    """Origin of each tensor of a network.

    Attributes:
        loaded: Names of tensors loaded unchanged.
        adapted: Changes of the tensors that were adapted, by name.
        fresh: Reasons why tensors kept their values, by name.
        unused: Names in the file that the network does not have.
        share: Fraction of the network's parameters that come from the file.
    """

    loaded: tuple[str, ...]
    adapted: dict[str, str]
    fresh: dict[str, str]
    unused: tuple[str, ...]
    share: float

    def __str__(self) -> str:
        """Return lines for the terminal."""
        lines = [f"loaded: {len(self.loaded)} tensors, {self.share:.1%} of the network's numbers"]
        for kind, reasons in (
            ("adapted", self.adapted),
            ("untrained", self.fresh),
            ("not used", dict.fromkeys(self.unused, "not in the network")),
        ):
            lines += [f"{kind}: {len(reasons)}"] * bool(reasons)
            for reason in dict.fromkeys(reasons.values()):
                names = [name for name, given in reasons.items() if given == reason]
                lines.append(f"  {reason}: {', '.join(names)}")
        return printable("\n".join(lines))


def initialize(
    network: nn.Module,
    path: Path | str,
    channels: tuple[Sequence[str], Sequence[str]] | None = None,
    of_other_classes: Collection[str] = (),
) -> Origins:
    """Load matching tensors from a checkpoint, state dict or safetensors file, in place.

    Names are matched by `tensors_for`, even if one of the networks is wrapped in another module
    (`SphereContext`, `AuxiliaryHead`). Filters of the first convolution for input channels that the
    file lacks start at zero (paper, supplement, "Level 10 parameters"), so RGB-D starts as RGB.
    Other tensors with another shape keep their values, e.g. the last layer for other classes.

    Args:
        network: Network, changed in place.
        path: File; only tensors and plain values are read.
        channels: Names of the input channels of the file's network and of this network, by which
            filters of the first convolution are matched; by default by position.
        of_other_classes: Names of tensors that keep their values although they have the shape of
            those in the file, because their scores belong to other classes.

    Raises:
        DataError: The file cannot be read, or none of its tensors fits.
    """
    path = Path(path)
    current = network.state_dict()
    found = tensors_for(network, path)
    convolutions = (name for name, m in network.named_modules() if isinstance(m, nn.Conv2d))
    stem = f"{next(convolutions, None)}.weight".removeprefix(".")
    loaded: dict[str, Tensor] = {}
    adapted: dict[str, str] = {}
    fresh: dict[str, str] = {}
    for name, tensor in current.items():
        given = found.get(name)
        if given is None:
            fresh[name] = "not in the file"
        elif name in of_other_classes and given.shape == tensor.shape:
            fresh[name] = "of other classes in the file"
        elif name == stem and given.ndim == 4 and given[:, 0].shape == tensor[:, 0].shape:
            loaded[name], changes = _by_channel(given, tensor, channels)
            if changes:
                adapted[name] = changes
        elif given.shape == tensor.shape:
            loaded[name] = given
        else:
            fresh[name] = f"{tuple(given.shape)} in the file, {tuple(tensor.shape)} here"
    if not any(name in loaded for name, _ in network.named_parameters()):
        raise DataError(
            path,
            found="no tensor that fits" + (f", but {next(iter(found))}" if found else ""),
            expected=f"tensors of {type(network).__name__}, {next(iter(current))} for one",
            remedy="Is it a checkpoint of the same network, with the same settings?",
        )
    network.load_state_dict({**current, **loaded})
    return Origins(
        loaded=tuple(name for name in loaded if name not in adapted),
        adapted=adapted,
        fresh=fresh,
        unused=tuple(name for name in found if name not in current),
        share=sum(min(found[name].numel(), t.numel()) for name, t in loaded.items())
        / sum(t.numel() for t in current.values()),
    )


def _by_channel(
    given: Tensor, wanted: Tensor, channels: tuple[Sequence[str], Sequence[str]] | None
) -> tuple[Tensor, str]:
    """Return filters for the wanted channels, and a description of the change."""
    before, now = channels or ((), ())
    if (len(before), len(now)) != (given.shape[1], wanted.shape[1]):
        before, now = ([f"channel {k}" for k in range(t.shape[1])] for t in (given, wanted))
    new = ", ".join(name for name in now if name not in before)
    lost = ", ".join(name for name in before if name not in now)
    notes = [f"starts at zero: {new}"] * bool(new) + [f"left out: {lost}"] * bool(lost)
    places = [before.index(name) if name in before else None for name in now]
    return select_channels(given, places), "; ".join(notes)
