"""Load trained networks from checkpoints and from files that `tangent-export` wrote."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from datamodules.core.inputs import Input, Normalization, channel_names
from datamodules.core.labels import DISTANCE, PIXEL_CLASSES
from models.onnx_network import OnnxNetwork, graph_checksum
from tangent_train.checkpoints.content import (
    GROUPS,
    INPUTS,
    NORMALIZATION,
    read_checkpoint,
)
from tangent_train.checkpoints.distances import DistanceNetwork
from tangent_train.checkpoints.kinds import DepthKind, ScoreKind
from tangent_train.checkpoints.scores import ClassScoreNetwork, Groups, size_multiple_of
from tangent_train.config.build import (
    SettingsFile,
    Text,
    build_from_config,
    check_fields,
    check_plain,
)
from tangent_train.errors import DataError, SettingError, first_line
from tangent_train.files import check_sum, crc32_of, load_plain, parse_json
from tangent_train.io.gpano import Fill

METADATA_KEY = "tangent_train"
"""Key of the JSON text in an ONNX file's ``metadata_props`` or safetensors' ``__metadata__``."""

CHECKSUM_KEY = "tangent_train_crc32"
"""Key of the checksum of the tensors in the same metadata."""

_PREFIX = "network."
"""Prefix of the names of the network's tensors in a checkpoint."""

_PRETRAINED = ("weights", "weights_backbone", "encoder_weights", "pretrained")
"""Settings that name trained weights, in models, torchvision, segmentation-models-pytorch, timm."""

_FROM_DATA = ("num_classes", "classes", "in_channels")
"""Settings that are taken from the data."""

_WHOLE_SPHERE = "EquirectRepresentation", "IcosphereRepresentation"
"""Representations with one view of the whole sphere."""

_OF_NETWORK = {"class_names", "depth_kind", "groups", "inputs", "normalization", "score_kind"}
"""Fields of checkpoints that describe the network."""

_EXPORTED = "a network written by tangent-export"
_TRAINED = "a checkpoint written by tangent-train"


@dataclass(frozen=True)
class LoadedNetwork:
    """A trained network with everything needed to use it.

    Attributes:
        module: Network as it was trained or imported, in evaluation mode; see `network`.
        class_names: Names of the K + 1 labels, the unknown class first; score k is that of label
            k + 1. Empty for depth networks.
        inputs: Inputs of the network, see `datamodules.core.inputs.Input`.
        normalization: Normalization of RGB and depth.
        level: Level s of the training.
        representation: Section ``representation`` of the training's config.
        image_size: Rows and columns of the images in an evaluation of that representation.
        size_multiple: Number that height and width of images must be multiples of.
        fixed_size: Rows and columns of the only image size that the network takes; None if it
            takes other sizes. Larger images are divided, or resized for depth networks, except for
            `is_spherical`.
        photo_level: Level s with the pixels per degree of the photos that an imported network was
            trained on; None for other networks.
        groups: Indices of a photo network's scores for each class, and in a last group those of no
            class: where they win, the label is 0. None if each score is a class.
        score_kind: Kind of the output of `module`, if it predicts classes.
        depth_kind: Kind of the output of a depth network; None for networks of classes.
        fill: Colors outside the area of partial panoramas in the training.
        settings: Complete section of the config that builds `module`; None if only the computation
            is known (ONNX).
        source: File that `representation` and `settings` come from.
    """

    module: nn.Module
    class_names: tuple[str, ...]
    inputs: tuple[Input, ...]
    normalization: Normalization
    level: int
    representation: Mapping[str, Any]
    image_size: tuple[int, int]
    size_multiple: int = 1
    fixed_size: tuple[int, int] | None = None
    photo_level: int | None = None
    groups: Groups | None = None
    score_kind: ScoreKind = "logits"
    depth_kind: DepthKind | None = None
    fill: Fill = "mean"
    settings: Mapping[str, Any] | None = None
    source: SettingsFile | None = None

    @cached_property
    def network(self) -> ClassScoreNetwork | DistanceNetwork:
        """Network that returns scores of K classes ``(B, K, h, w)``, or depth ``(B, 1, h, w)``.

        With `groups`, a further score is that of no class. Images are ``(B, C, h, w)`` float32,
        normalized.
        """
        count = len(self.class_names) - 1
        tile = None if self.is_spherical else self.fixed_size
        if self.depth_kind is not None:
            return DistanceNetwork(self.module, self.depth_kind, tile).eval()
        return ClassScoreNetwork(self.module, count, self.groups, tile, self.score_kind).eval()

    @property
    def predicts(self) -> str:
        """Kind of labels that the network predicts, see `datamodules.core.labels`."""
        return PIXEL_CLASSES if self.depth_kind is None else DISTANCE

    def check_predicts(self, needed: str, remedy: str = "") -> None:
        """Refuse networks with other predictions than needed.

        Args:
            needed: Kind of labels, see `datamodules.core.labels`.
            remedy: Remedy in the message.

        Raises:
            SettingError: The network predicts another kind of labels.
        """
        if self.predicts != needed:
            raise SettingError(
                "checkpoint",
                found=f"a network that predicts {self.predicts}",
                expected=f"a network that predicts {needed}",
                remedy=remedy,
            )

    @property
    def is_spherical(self) -> bool:
        """True if the network takes only whole spheres of the size of its training."""
        kind = str(self.representation["_target_"]).rpartition(".")[2]
        return self.fixed_size == self.image_size and kind in _WHOLE_SPHERE

    @property
    def photo_side(self) -> int | None:
        """Side of the views if it does not depend on the level: fixed size, or imported network."""
        if self.fixed_size is not None and not self.is_spherical:
            return max(self.fixed_size)
        return None if self.photo_level is None else self.image_size[1]

    @property
    def in_channels(self) -> int:
        """Number of input channels."""
        return len(channel_names(self.inputs))

    def labels(self, best: Tensor) -> NDArray[np.unsignedinteger]:
        """Convert indices of the best scores to labels.

        Args:
            best: Indices of scores.

        Returns:
            Labels from 1 to K; 0 where an unknown class, or no class, had the best score.
        """
        labels: NDArray[np.unsignedinteger] = best.cpu().numpy()
        labels = labels + labels.dtype.type(1)
        labels[labels >= len(self.class_names)] = 0
        return labels


@dataclass(frozen=True)
class NetworkDescription:
    """The description of the network that training starts from.

    Attributes:
        class_names: Names of the labels.
        inputs: Inputs of the network; None for shapes.
        normalization: ``mean`` and ``std`` of the inputs.
        groups: Indices of scores, see `LoadedNetwork`.
        score_kind: Kind of the output, see `LoadedNetwork`.
        depth_kind: Kind of the output of a depth network, see `LoadedNetwork`.
        settings: Section of a config that builds the network. Settings that depend on the data (see
            `completed_settings`) and those of other pretrained weights are null.
    """

    class_names: tuple[str, ...]
    inputs: tuple[Input, ...] | None
    normalization: Mapping[str, Sequence[float]]
    groups: Groups | None
    score_kind: ScoreKind
    depth_kind: DepthKind | None
    settings: dict[str, Any]


_KINDS = {
    "class_names": list[Text],
    "inputs": INPUTS,
    "normalization": NORMALIZATION,
    "level": int,
    "representation": dict,
    "image_size": list[int],
    "size_multiple": int,
    "fixed_size": list[int] | None,
    "photo_level": int | None,
    "groups": GROUPS,
    "score_kind": ScoreKind,
    "depth_kind": DepthKind | None,
    "fill": Fill | None,
    "settings": dict | None,
}
"""Fields in the metadata of an exported network, with their kinds."""


def completed_settings(
    settings: Any, in_channels: int, num_classes: int, *, restored: bool = False
) -> Any:
    """Complete null settings of a network, and of networks inside it, from the data.

    Args:
        settings: Resolved settings; ``in_channels``, ``num_classes`` and ``classes`` may be null.
        in_channels: Number of input channels.
        num_classes: Number of scores of the network.
        restored: True if the tensors come from a checkpoint: pretrained weights are not fetched.
    """
    known = dict.fromkeys(_FROM_DATA, num_classes) | {"in_channels": in_channels}
    unwanted = _PRETRAINED if restored else ()

    def complete(value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        return {
            name: known.get(name) if inner is None or name in unwanted else complete(inner)
            for name, inner in value.items()
        }

    return complete(settings)


def load_network(path: Path, trust: Collection[str] = ()) -> LoadedNetwork:
    """Load a trained network, on the CPU and in evaluation mode, from a file of this package.

    Args:
        path: Checkpoint, or a file of `tangent-export` with the suffix ``.onnx`` or
            ``.safetensors``.
        trust: Full names of classes that the file may name besides the registered ones.

    Raises:
        DataError: The file is missing, has other content, names classes that are not allowed, or
            its network cannot be built; or a package to read it is missing.
    """
    suffix, source = path.suffix.lower(), SettingsFile(path, trust)
    try:
        if suffix == ".onnx":
            return _from_onnx(source)
        return _from_safetensors(source) if suffix == ".safetensors" else _from_checkpoint(source)
    except DataError:
        raise
    except SettingError as error:
        found = f"{error.subject}: {error.found}"
        raise DataError(path, found=found, expected=error.expected, remedy=error.remedy) from error
    except (AttributeError, TypeError, ValueError) as error:  # invalid sections
        raise DataError(path, found=f"{error}", expected=_TRAINED) from error


def describe_network(path: Path) -> NetworkDescription | None:
    """Return the description of the network in a file of this package; None for other files.

    Raises:
        DataError: The file is missing, or its description cannot be used.
    """
    if path.suffix.lower() == ".safetensors":
        metadata = _metadata(path)
        if METADATA_KEY not in metadata:
            return None
        content = _parse_metadata(path, metadata)
    else:
        names = _OF_NETWORK | {"config", "predicts"}
        plain = load_plain(path, f"{_TRAINED}, or a state dict", mmap=True, whole=False)
        if not isinstance(plain, Mapping) or "tangent_train_version" not in plain:
            return None
        content = read_checkpoint(path, names)
        content["settings"] = content["config"].get("network")
        content["depth_kind"] = _depth_kind(content)
    if not isinstance(content["settings"], Mapping):
        return None
    return NetworkDescription(
        class_names=tuple(content["class_names"]),
        inputs=tuple(content["inputs"] or ()) or None,
        normalization=content["normalization"],
        groups=content["groups"],
        score_kind=content["score_kind"] or "logits",
        depth_kind=content["depth_kind"],
        settings=_without_data_settings(content["settings"]),
    )


def _without_data_settings(section: Any) -> Any:
    """Set settings that depend on the data, and pretrained weights, to null."""
    if not isinstance(section, Mapping) or "_target_" not in section:
        return section
    return {
        name: None if name in (*_FROM_DATA, *_PRETRAINED) else _without_data_settings(value)
        for name, value in section.items()
    }


def metadata_of(trained: LoadedNetwork) -> dict[str, Any]:
    """Return the metadata of a network as plain values.

    These are the fields of `LoadedNetwork`, except for ``module`` and ``source``;
    ``normalization`` is a mapping of ``mean`` and ``std``; ``tangent_train_version`` is added.
    """
    content = {name: getattr(trained, name) for name in _KINDS}
    content["normalization"] = asdict(trained.normalization)
    return content | {"tangent_train_version": version("tangent-train")}


def _check_tensors(path: Path, metadata: Mapping[str, str], checksum: str) -> None:
    """Refuse tensors with a wrong checksum; other programs write no checksum."""
    check_sum(path, metadata.get(CHECKSUM_KEY, checksum) == checksum)


def write_metadata(source: Path, path: Path, trained: LoadedNetwork) -> None:
    """Write an ONNX file with the metadata of a network, and the checksum of its tensors.

    Args:
        source: ONNX file without external tensors.
        path: File to write.
        trained: Network that the ONNX file computes.
    """
    import onnx

    graph = onnx.load(source, format="protobuf")
    entries = {entry.key: entry.value for entry in graph.metadata_props}
    entries |= {METADATA_KEY: json.dumps(metadata_of(trained)), CHECKSUM_KEY: graph_checksum(graph)}
    onnx.helper.set_model_props(graph, entries)
    onnx.save(graph, path, format="protobuf")


def tensor_checksum(tensors: Mapping[str, Tensor]) -> str:
    """Return the CRC-32 of the numbers in contiguous tensors, in the order of their names."""
    ordered = (tensors[name].reshape(-1).view(torch.uint8) for name in sorted(tensors))
    return crc32_of(tensor.numpy().data for tensor in ordered)


def _from_onnx(source: SettingsFile) -> LoadedNetwork:
    network = OnnxNetwork(source.path)
    described = _parse_metadata(source.path, network.metadata) | {"settings": None}
    _check_tensors(source.path, network.metadata, network.checksum)
    return _build_trained(described, network, source)


def _from_safetensors(source: SettingsFile) -> LoadedNetwork:
    metadata = _metadata(source.path)
    described = _parse_metadata(source.path, metadata)
    tensors = load_file(source.path)
    _check_tensors(source.path, metadata, tensor_checksum(tensors))
    return _build_trained(described, _build_network(described, tensors, source), source)


def _from_checkpoint(source: SettingsFile) -> LoadedNetwork:
    """Load a network, and find by trial the sizes of images that it takes."""
    path = source.path
    content = read_checkpoint(path)
    if content["predicts"] not in (PIXEL_CLASSES, DISTANCE):
        raise DataError(
            path,
            found=f"a network that predicts {content['predicts'] or 'something else'}",
            expected=f"a network that predicts {PIXEL_CLASSES} or {DISTANCE}",
            remedy=f"Networks of all tasks: tangent-evaluate checkpoint={path}.",
        )
    kinds = {"network": dict, "representation": dict, "level": int}
    described = check_fields(path, content["config"], kinds, _TRAINED, "its config")
    described["settings"] = described.pop("network")
    fill = (content["config"].get("data") or {}).get("fill")
    described["fill"] = fill if fill in get_args(Fill) else None
    names = _OF_NETWORK | {"fixed_size", "photo_level"}
    described |= {"inputs": (), **{n: content[n] for n in names if content[n] is not None}}
    described["depth_kind"] = _depth_kind(content)
    tensors = {
        name.removeprefix(_PREFIX): tensor
        for name, tensor in content["state_dict"].items()
        if str(name).startswith(_PREFIX)
    }
    trained = _build_trained(described, _build_network(described, tensors, source), source)
    if trained.fixed_size is not None:
        return trained
    multiple = size_multiple_of(trained.network, trained.in_channels)
    fixed = None if multiple else trained.image_size
    return replace(trained, size_multiple=multiple or 1, fixed_size=fixed)


def _depth_kind(content: Mapping[str, Any]) -> DepthKind | None:
    """Return the kind of a depth network in a checkpoint; None for a network of classes."""
    kind: DepthKind = content["depth_kind"] or "log_distance"
    return kind if content["predicts"] == DISTANCE else None


def _build_network(
    described: dict[str, Any], tensors: Mapping[str, Tensor], source: SettingsFile
) -> nn.Module:
    """Build a network with the tensors of its file; complete its settings in place."""
    if described["settings"] is None:
        raise DataError(source.path, found="no settings of the network", expected=_EXPORTED)
    is_depth = described.get("depth_kind") is not None
    channels = len(channel_names(described["inputs"]))
    outputs = 1 if is_depth else len(described["class_names"]) - 1
    settings = completed_settings(described["settings"], channels, outputs, restored=True)
    described["settings"] = settings
    network: nn.Module = build_from_config(settings, "network", source)
    try:
        network.load_state_dict(dict(tensors))
    except (RuntimeError, TypeError, AttributeError) as error:
        raise DataError(
            source.path,
            found=f"other tensors than those of its network ({error})",
            expected=f"the tensors of {settings['_target_']}",
            remedy="Install the version of the network's package that it was trained with.",
        ) from error
    return network.eval()


def _build_trained(
    described: Mapping[str, Any], network: nn.Module, source: SettingsFile
) -> LoadedNetwork:
    # Built to refuse an impossible representation before it is used.
    representation = build_from_config(described["representation"], "representation", source)
    rows, columns = described.get("image_size", representation.image_size)
    normalization, fixed = described["normalization"], described.get("fixed_size")
    if fixed is not None and min(fixed) < 1:
        raise ValueError(f"fixed_size={fixed}")
    known = {
        "module": network,
        "class_names": tuple(described["class_names"]),
        "inputs": tuple(described["inputs"]),
        "normalization": Normalization(normalization.get("mean", ()), normalization.get("std", ())),
        "image_size": (rows, columns),
        "fixed_size": None if fixed is None else (fixed[0], fixed[1]),
        "fill": described["fill"] or "mean",  # exports of older versions lack it
        "source": source,
    }
    return LoadedNetwork(**{**described, **known})


def _parse_metadata(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Parse the description of a network in the metadata of its file."""
    where = f"'{METADATA_KEY}' of its metadata"
    try:
        content = parse_json(metadata.get(METADATA_KEY, ""))
    except ValueError as error:
        raise DataError(
            path,
            found=f"no JSON in {where} ({error})",
            expected=_EXPORTED,
            remedy="These are the classes and normalization of the network. tangent-import writes "
            "them for a network of another program.",
        ) from error
    return check_fields(path, check_plain(path, content, where), _KINDS, _EXPORTED, where)


def _metadata(path: Path) -> dict[str, str]:
    """Read the metadata of a safetensors file."""
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}
    except (SafetensorError, OSError) as error:
        found = f"an unreadable file ({first_line(error)})" if path.is_file() else "no such file"
        raise DataError(path, found=found, expected=_EXPORTED) from error
