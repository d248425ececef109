"""Starting a network from the tensors of another one: what fits, adapted where only ends differ."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.table import Table
from rich.text import Text
from torch import Tensor, nn

from models.held import HELD
from models.pretrained import read_tensors
from models.stem import of_channels, with_channels
from tangent_train.errors import DataError, printable

__all__ = ["Origins", "initialize", "origins_table"]

Channels = tuple[Sequence[str], Sequence[str]]
"""Names of the channels of images, in a file and here."""

_LISTED = 8


class Origins(NamedTuple):
    """Where the tensors of a network come from.

    Attributes:
        loaded: Names of those taken as they are.
        share: Of the network's numbers, the part that came from the file.
        adapted: Of those changed to fit, how.
        fresh: Of those left as they were, why.
        unused: Names in the file that the network does not have.
    """

    loaded: tuple[str, ...]
    share: float
    adapted: dict[str, str]
    fresh: dict[str, str]
    unused: tuple[str, ...]


def initialize(network: nn.Module, path: Path | str, channels: Channels | None = None) -> Origins:
    """Load what fits from a checkpoint, a state dict or a safetensors file, in place.

    Names are compared behind the prefix under which most of them are the network's (``module.``,
    ``model.net.``, …), in the file or, where that has none, in the network. ``network.`` counts
    nowhere: a network fits into modules that hold one, as `SphereContext` and `AuxiliaryHead` do,
    and out of them, their own tensors among themselves. Of the first convolution,
    filters of further input channels start at zero, so RGB-D begins as RGB; ones the network has no
    channel for are left out. Other tensors of another shape stay as they are: the last layer, for
    another number of classes.

    Args:
        network: Into which.
        path: The file. Nothing but tensors and plain values is unpickled.
        channels: Names of the channels of the images that the file's network takes, and of those
            that this one takes: filters go by name. By default the first ones are the same.

    Raises:
        DataError: The file cannot be read, or nothing in it fits.
    """
    path = Path(path)
    own = network.state_dict()
    found = _renamed(read_tensors(path), own)
    stem = _stem_name(network)
    loaded: dict[str, Tensor] = {}
    adapted: dict[str, str] = {}
    fresh: dict[str, str] = {}
    for name, tensor in own.items():
        given = found.get(name)
        if given is None:
            fresh[name] = "not in the file"
        elif name == stem and channels and _fits(given, tensor, channels):
            loaded[name], adapted[name] = _by_channel(given, channels)
        elif given.shape == tensor.shape:
            loaded[name] = given
        elif name == stem and _differ_in_channels_only(given, tensor):
            loaded[name] = with_channels(given, tensor.shape[1])
            adapted[name] = f"{given.shape[1]} → {tensor.shape[1]} channels"
        else:
            fresh[name] = f"{tuple(given.shape)} in the file, {tuple(tensor.shape)} here"
    if not any(name in loaded for name, _ in network.named_parameters()):
        raise DataError(
            path,
            found="no tensor that fits" + (f", but {next(iter(found))}" if found else ""),
            expected=f"tensors of {type(network).__name__}, {next(iter(own))} for one",
            remedy="Is it a checkpoint of the same network, with the same settings?",
        )
    network.load_state_dict({**own, **loaded})
    plain = tuple(name for name in loaded if name not in adapted)
    numbers = sum(tensor.numel() for tensor in own.values())
    share = sum(tensor.numel() for tensor in loaded.values()) / numbers
    return Origins(plain, share, adapted, fresh, tuple(name for name in found if name not in own))


def _fits(given: Tensor, wanted: Tensor, channels: Channels) -> bool:
    """Whether filters can and have to go by the names of their channels."""
    counts = (given.shape[1], wanted.shape[1])
    named = counts == (len(channels[0]), len(channels[1]))
    return channels[0] != channels[1] and named and _differ_in_channels_only(given, wanted)


def _by_channel(given: Tensor, channels: Channels) -> tuple[Tensor, str]:
    """Filters for the channels wanted, and what became of the others."""
    before, now = channels
    places = {name: place for place, name in enumerate(before)}
    new, lost = (
        ", ".join(name for name in these if name not in those)
        for these, those in ((now, before), (before, now))
    )
    notes = [f"starts at zero: {new}"] * bool(new) + [f"left out: {lost}"] * bool(lost)
    return of_channels(given, [places.get(name) for name in now]), "; ".join(notes)


def origins_table(origins: Origins, path: Path | str) -> Table:
    """What was loaded, adapted and left fresh, for the terminal.

    Args:
        origins: From `initialize`.
        path: The file, for the title.
    """
    table = Table(title=Text(f"Tensors from {path}"), title_justify="left")
    for heading in ("", "tensors", "which"):
        table.add_column(heading, justify="right" if heading == "tensors" else "left")
    share = f"{origins.share:.0%} of the network's numbers, with the adapted ones"
    table.add_row("loaded", str(len(origins.loaded)), share)
    for kind, reasons in (("adapted", origins.adapted), ("fresh", origins.fresh)):
        lines = [f"{name}: {reason}" for name, reason in reasons.items()]
        table.add_row(kind, str(len(lines)), _listed(lines))
    table.add_row("not used", str(len(origins.unused)), _listed(list(origins.unused)))
    return table


def _renamed(tensors: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors by the network's names, whatever modules hold the network here and there."""
    inner, inner_own = ({_inner(name): name for name in names} for names in (tensors, own))
    if len(inner) < len(tensors) or len(inner_own) < len(
        own
    ):  # names that only wrappers tell apart
        return _by_prefix(tensors, own)
    found = _by_prefix({name: tensors[full] for name, full in inner.items()}, inner_own)
    return {inner_own.get(name, name): tensor for name, tensor in found.items()}


def _inner(name: str) -> str:
    """The name without the parts by which a network is called in modules that hold one."""
    return ".".join(part for part in name.split(".") if part != HELD)


def _by_prefix(tensors: Mapping[str, Tensor], own: Iterable[str]) -> dict[str, Tensor]:
    """The tensors by the names behind, or with, the prefix under which most are the network's."""
    prefix = _commonest(_prefixes(tensors, own))
    if prefix is not None:
        return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}
    # A network inside this one.
    prefix = _commonest(_prefixes(own, tensors)) or ""
    return {prefix + name: tensor for name, tensor in tensors.items()}


def _prefixes(names: Iterable[str], ends: Iterable[str]) -> Counter[str]:
    """How many names are made of a prefix and one of the ends, for every such prefix."""
    ends = list(ends)
    return Counter(
        name[: len(name) - len(end)]
        for name in names
        for end in ends
        if name == end or name.endswith(f".{end}")
    )


def _commonest(counts: Counter[str]) -> str | None:
    """The one that is there most often, of equals the shortest."""
    return min(counts, key=lambda prefix: (-counts[prefix], len(prefix)), default=None)


def _stem_name(network: nn.Module) -> str | None:
    """The weight of the first convolution, in the order of definition."""
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            return f"{name}.weight" if name else "weight"
    return None


def _differ_in_channels_only(given: Tensor, wanted: Tensor) -> bool:
    return given.shape[:1] + given.shape[2:] == wanted.shape[:1] + wanted.shape[2:]


def _listed(lines: list[str]) -> Text:
    """Some lines; names of tensors may be anybody's."""
    more = [f"and {len(lines) - _LISTED} more"] if len(lines) > _LISTED else []
    return Text(printable("\n".join(lines[:_LISTED] + more)))
