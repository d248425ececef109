"""Tensors of trained networks: reading, loading, and initialization of other networks from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from tangent_train.errors import DataError, SettingError, first_line, printable
from tangent_train.files import load_plain

_RGB = 3

_PREFIX = "network."
"""Prefix of the network's tensors in checkpoints of this package."""

_COUNTER = "num_batches_tracked"
"""Buffer of batch normalization that older files lack and this package does not use."""


def tensors_for(network: nn.Module, path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file under the names that a network has for them.

    The mapping (``state_dict``, ``model``, or the whole file) and prefix (``module.``,
    ``_orig_mod.``, ``model.net.``, …) with the most fitting names are used; of several equally good
    ones, ``state_dict``. Names are compared without ``network.`` and without the most common prefix
    of the network's names.

    Args:
        network: Network that the tensors are for.
        path: File, see `read_tensors`.

    Raises:
        DataError: The file cannot be read.
    """
    names = {_inner(name): name for name in network.state_dict()}
    given = {
        place: {_inner(name): tensor for name, tensor in tensors.items()}
        for place, tensors in read_tensors(path).items()
    }
    fitting: dict[tuple[str, str, str], int] = {}
    for place, tensors in given.items():
        inside, count = _prefixes(names, tensors)[0]
        for outside, of_outside in _prefixes(tensors, names):
            fitting[place, outside, inside] = max(count, of_outside)
    best = [key for key, count in fitting.items() if count == max(fitting.values())]
    place, outside, inside = next((key for key in best if key[0] == "state_dict"), best[0])
    new = {n: inside + n.removeprefix(outside) for n in given[place] if n.startswith(outside)}
    return {names.get(after, after): given[place][before] for before, after in new.items()}


def read_tensors(path: Path) -> dict[str, dict[str, Tensor]]:
    """Read the mappings with tensors in a file, by key, e.g. ``state_dict``; "" is the file.

    Names in nested mappings are joined by dots. If ``state_dict`` has tensors under ``network.``,
    as in checkpoints of this package, only these are returned.

    Args:
        path: File from `torch.save`, from which only tensors and plain values are unpickled, or a
            ``.safetensors`` file.

    Raises:
        DataError: The file is missing, or has another content.
    """
    expected, found = "a state dict of tensors, or a checkpoint with one", "no named tensors"
    content: Any = None
    try:
        is_safe = path.suffix == ".safetensors"
        content = load_file(path) if is_safe else load_plain(path, expected)
    except (SafetensorError, OSError) as error:
        found = f"an unreadable file ({error})" if path.is_file() else "no such file"
    mappings = _mappings(content) if isinstance(content, Mapping) else {}
    if not mappings:
        raise DataError(path, found=found, expected=expected)
    whole = mappings.get("state_dict", {})
    prefixed = {name: tensor for name, tensor in whole.items() if name.startswith(_PREFIX)}
    return mappings | ({"state_dict": prefixed} if prefixed else {})


def _mappings(content: Mapping[Any, Any]) -> dict[str, dict[str, Tensor]]:
    """Return the mappings with tensors in a mapping; "" is itself."""
    tensors: dict[str, Tensor] = {}
    inside: dict[str, dict[str, Tensor]] = {}
    for name, value in content.items():
        if not isinstance(name, str):
            continue
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, Mapping):
            found = _mappings(value)
            inside |= {f"{name}.{place}".rstrip("."): within for place, within in found.items()}
            tensors |= {f"{name}.{inner}": tensor for inner, tensor in found.get("", {}).items()}
    return ({"": tensors} if tensors else {}) | inside


def _inner(name: str) -> str:
    """Return a name without the attributes of this package's wrapper modules."""
    return ".".join(part for part in name.split(".") if part != "network")


def _prefixes(names: Iterable[str], ends: Mapping[str, object]) -> list[tuple[str, int]]:
    """Return the prefixes of names with these ends and their counts, most common first."""
    counts: Counter[str] = Counter()
    for name in names:
        parts = name.split(".")
        for k in range(len(parts)):
            if ".".join(parts[k:]) in ends:
                counts["".join(f"{part}." for part in parts[:k])] += 1
    return sorted(counts.items(), key=lambda item: (-item[1], len(item[0]))) or [("", 0)]


def fetch_tensors(weights: str) -> dict[str, Tensor]:
    """Return tensors published by torchvision, from the local cache or the internet."""
    from torchvision.models import get_weight  # slow to import

    return dict(
        get_weight(weights).get_state_dict(
            progress=True, check_hash=True, map_location="cpu", weights_only=True
        )
    )


def load_tensors(
    network: nn.Module, tensors: Mapping[str, Tensor], source: object, fresh: str | None = None
) -> None:
    """Load all tensors of a network.

    Args:
        network: Network, changed in place.
        tensors: Tensors by name; one of the names suffices for a tensor that several share.
        source: File of the tensors, for the message.
        fresh: Prefix of the names of tensors that are not loaded; None to load all.

    Raises:
        DataError: Tensors are missing, unexpected or of another shape.
    """
    own = network.state_dict()
    given = {own[name].data_ptr() for name in own.keys() & tensors.keys()}
    kept = {
        name: tensor
        for name, tensor in own.items()
        if _COUNTER in name
        or (fresh is not None and name.startswith(fresh))
        or (tensor.numel() and tensor.data_ptr() in given)
    }
    try:
        network.load_state_dict({**kept, **tensors})
    except (RuntimeError, TypeError, AttributeError) as error:
        # torch lists the differences below the title of its message.
        title, _, differences = str(error).partition("\n")
        found = first_line(differences or title)
        expected = f"all tensors of {type(network).__name__}, for the same classes and settings"
        raise DataError(source, found=found, expected=expected) from error


def widen_stem(network: nn.Module, in_channels: int) -> nn.Module:
    """Extend a network for RGB images to additional channels, such as depth.

    The filters of additional channels start at zero (paper, supplement, "Level 10 parameters"), so
    that the network first returns the same for RGB-D as for RGB.

    Args:
        network: Network whose first convolution processes the image, of three channels.
        in_channels: Number of channels, 3 or more; the first three are red, green and blue.

    Returns:
        The network, changed in place.

    Raises:
        SettingError: The first convolution has other channels.
    """
    stem = next(module for module in network.modules() if isinstance(module, nn.Conv2d))
    if (stem.in_channels, stem.groups) != (_RGB, 1):
        raise SettingError("data.inputs", found=stem, expected="a first convolution of RGB images")
    places = [*range(_RGB), *[None] * (in_channels - _RGB)]
    stem.weight = nn.Parameter(select_channels(stem.weight.detach(), places))
    stem.in_channels = in_channels
    return network


def select_channels(weight: Tensor, places: Sequence[int | None]) -> Tensor:
    """Return filters for a selection of input channels.

    Args:
        weight: ``(out, in, h, w)`` filters.
        places: Index in `weight` of each new channel; None for zeros.

    Returns:
        ``(out, len(places), h, w)``.
    """
    zeros = torch.zeros_like(weight[:, 0])
    return torch.stack([zeros if k is None else weight[:, k] for k in places], dim=1)


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
    (`AuxiliaryHead`). Filters of the first convolution for input channels that the
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
