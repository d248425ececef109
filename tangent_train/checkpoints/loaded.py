"""Networks in files: checkpoints of runs, imported and exported networks."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import nn

from datamodules.core.inputs import Input, Normalization, channel_names
from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from models.onnx_network import OnnxNetwork
from models.pretrained import load_tensors
from models.prompted import PromptedNetwork
from tangent_train.checkpoints.outputs import OutputNetwork
from tangent_train.config.build import filled
from tangent_train.config.from_file import build_from_file, without_weights
from tangent_train.config.settings import Prompts, texts_of_classes
from tangent_train.errors import DataError, SettingError, first_line, wrong_field
from tangent_train.files import checked_file, load_plain
from tangent_train.geometry.camera import half_width
from tangent_train.io.gpano import Fill
from tangent_train.io.image_files import composed
from tangent_train.kinds import DepthKind, ScoreKind, depth_channels

METADATA_KEY = "tangent_train"
"""Key of the description of a network: in a checkpoint, in the ``metadata_props`` of an ONNX file
and in the ``__metadata__`` of a safetensors file (as JSON)."""

_PREFIX = "network."
"""Prefix of the names of the network's tensors in a checkpoint."""

_FROM_DATA = ("num_classes", "classes", "in_channels")
"""Settings that are taken from the data."""

_WHOLE_SPHERE = "EquirectRepresentation", "IcosphereRepresentation"
"""Representations with one view of the whole sphere."""

_EXPECTED = "a network of tangent-train, -import or -export"

_CONFIG = pydantic.ConfigDict(extra="forbid", arbitrary_types_allowed=True)

_Size = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class NetworkDescription:
    """Everything that a file contains about its network, besides the tensors.

    Attributes:
        predicts: Kind of labels that the network predicts, see `datamodules.core.label_map`.
        class_names: Names of the K + 1 labels, the unknown class first; score k is that of label
            k + 1. Empty for depth networks.
        inputs: Inputs of the network, see `datamodules.core.inputs.Input`; empty for shapes.
        normalization: Normalization of the inputs.
        level: Level s of the training.
        representation: Section ``representation`` of the training's config.
        image_size: Rows and columns of the images in an evaluation of that representation.
        size_multiple: Number that height and width of images must be multiples of.
        fixed_size: Rows and columns of the only image size that the network takes; None if it
            takes other sizes. Larger images are divided, or resized for depth networks, except for
            `is_spherical`.
        photo_level: Level s with the pixels per degree of the photos that an imported network was
            trained on; None for other networks.
        photo_fov_deg: Horizontal and vertical field of view in degrees of these photos; None if
            unknown. The z-depth of a network of `canonical_z` is right for this camera.
        groups: Indices of a photo network's scores for each class, and in a last group those of no
            class: where they win, the label is 0. None if each score is a class.
        things: Names of the classes of which the network returns objects, see `Segments`.
        score_kind: Kind of the output of a network of classes.
        depth_kind: Kind of the output of a depth network; None for networks of classes.
        fill: Colors outside the area of partial panoramas in the training.
        settings: Complete section of the config that builds the network; None if only the
            computation is known (ONNX).
    """

    predicts: str = PIXEL_CLASSES
    class_names: tuple[str, ...]
    inputs: tuple[Input, ...]
    normalization: Normalization
    level: int
    representation: dict[str, Any]
    image_size: _Size
    size_multiple: Annotated[int, Field(ge=1)] = 1
    fixed_size: _Size | None = None
    photo_level: int | None = None
    photo_fov_deg: tuple[float, float] | None = None
    groups: tuple[tuple[int, ...], ...] | None = None
    things: tuple[str, ...] = ()
    score_kind: ScoreKind = "logits"
    depth_kind: DepthKind | None = None
    fill: Fill = "mean"
    settings: dict[str, Any] | None = None

    def plain(self) -> dict[str, Any]:
        """Return the description as plain values, with the version of this package."""
        fields: Any = pydantic.TypeAdapter(NetworkDescription).dump_python(self, mode="json")
        names = NetworkDescription.__dataclass_fields__
        described = {name: fields[name] for name in names}
        return described | {"tangent_train_version": version("tangent-train")}

    def check_predicts(self, needed: str, remedy: str = "") -> None:
        """Refuse networks with other predictions than needed.

        Args:
            needed: Kind of labels, see `datamodules.core.label_map`.
            remedy: Remedy in the message.

        Raises:
            SettingError: The network predicts another kind of labels.
        """
        if self.predicts != needed:
            raise SettingError(
                "checkpoint",
                found=f"a network that predicts {self.predicts or 'something else'}",
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
        return len(channel_names(self.inputs)) if self.inputs else self.normalization.channels

    @property
    def data_settings(self) -> dict[str, Any]:
        """Inputs and normalization, as settings of a data set."""
        return {name: self.plain()[name] for name in ("inputs", "normalization")}

    def trainable_settings(self) -> dict[str, Any] | None:
        """Return `settings` with null for those that depend on the data, and pretrained weights."""
        return _without_data_settings(without_weights(self.settings))


@dataclass(frozen=True, kw_only=True, config=_CONFIG)
class LoadedNetwork(NetworkDescription):
    """A network from a file, with everything needed to use it.

    Attributes:
        module: Network as it was trained or imported, in evaluation mode; see `network`.
        trust: Packages that the file may name besides the usual ones.
    """

    module: nn.Module
    trust: tuple[str, ...] = ()

    @cached_property
    def network(self) -> nn.Module:
        """Network that returns scores of K classes ``(B, K, h, w)``, or depth ``(B, 1, h, w)``.

        With `groups`, a further score is that of no class. Images are ``(B, C, h, w)`` float32,
        normalized. See `OutputNetwork` for further inputs and outputs.
        """
        tile = None if self.is_spherical else self.fixed_size
        if self.predicts == DISTANCE and self.depth_kind is not None:
            channels = depth_channels(self.depth_kind)
            known = self.photo_fov_deg if self.depth_kind == "canonical_z" else None
            gain = 2 * half_width(known[0]) if known else 1.0
            return OutputNetwork(self.module, channels, tile=tile, kind=None, gain=gain).eval()
        if self.predicts != PIXEL_CLASSES:
            return self.module
        count = len(self.class_names) - 1
        return OutputNetwork(self.module, count, self.groups, tile, self.score_kind).eval()

    def prompted(
        self, prompts: Prompts | None = None, threshold: float | None = None
    ) -> LoadedNetwork:
        """Return the network with other texts as classes; its `module` is changed.

        Args:
            prompts: Texts that name the classes; texts of each class by its name; or a ``.txt``
                file with a text per line. None to keep them.
            threshold: Probability that a class must exceed; None to keep it.

        Raises:
            SettingError: The network takes no text.
        """
        if prompts is None and threshold is None:
            return self
        if not isinstance(self.module, PromptedNetwork):
            found, expected = "a network without text", "CLIPSeg or SAM 3 of tangent-import"
            raise SettingError("checkpoint, with prompts=", found=found, expected=expected)
        texts = None if prompts is None else texts_of_classes(prompts)
        settings = {**(self.settings or {}), **self.module.set_prompts(texts, threshold)}
        if texts is None:
            return replace(self, settings=settings)
        names = tuple(map(composed, texts))
        return replace(
            self,
            class_names=("unknown", *names),
            groups=tuple((k,) for k in range(len(names) + 1)),
            things=names if self.things else (),
            settings=settings,
        )


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
    return filled(without_weights(settings) if restored else settings, known)


def _without_data_settings(section: Any) -> Any:
    if not isinstance(section, Mapping) or "_target_" not in section:
        return section
    return {
        name: None if name in _FROM_DATA else _without_data_settings(value)
        for name, value in section.items()
    }


def declared_sizes(module: nn.Module) -> tuple[int, tuple[int, int] | None]:
    """Return the image sizes that a network takes, as it, or a network inside it, declares them.

    Args:
        module: Network. It declares ``size_multiple``, or ``fixed_size`` if it takes one size only.
            Networks of segmentation-models-pytorch have ``encoder.output_stride``.

    Returns:
        Number that height and width must be multiples of, and the only size, see
        `NetworkDescription`.
    """
    parts = list(module.modules())
    stride = getattr(getattr(module, "encoder", None), "output_stride", 1)
    multiples = (getattr(part, "size_multiple", None) for part in parts)
    sizes = (getattr(part, "fixed_size", None) for part in parts)
    return next(filter(None, multiples), int(stride)), next(filter(None, sizes), None)


def load_network(path: Path, trust: Collection[str] = ()) -> LoadedNetwork:
    """Load a network, on the CPU and in evaluation mode, from a file of this package.

    Args:
        path: Checkpoint of a run or of ``tangent-import``, or a file of ``tangent-export`` with the
            suffix ``.onnx`` or ``.safetensors``.
        trust: Packages, modules or classes of the user that the file may name too.

    Raises:
        DataError: The file is missing, has other content, names classes that are not allowed, or
            its network cannot be built; or a package to read it is missing.
    """
    try:
        checked_file(path)
    except OSError as error:
        raise DataError(path, found=error, expected=_EXPECTED) from error
    onnx = OnnxNetwork(path) if path.suffix.lower() == ".onnx" else None
    if onnx is None:
        described = read_description(path)
    else:
        described = _parsed(path, onnx.metadata.get(METADATA_KEY))
    if described is None:
        raise DataError(path, found="no description of a network", expected=_EXPECTED)
    # Built to refuse a representation that is not allowed or impossible.
    build_from_file(described.representation, "representation", path, trust)
    if onnx is not None:
        return LoadedNetwork(**vars(described), module=onnx, trust=tuple(trust))
    classes, channels = len(described.class_names) - 1, described.in_channels
    settings = completed_settings(described.settings, channels, classes, restored=True)
    module: nn.Module = build_from_file(settings, "network", path, trust)
    if path.suffix.lower() == ".safetensors":
        tensors = load_file(path)
    else:
        stored = load_plain(path, _EXPECTED, mmap=True)["state_dict"].items()
        tensors = {n.removeprefix(_PREFIX): t for n, t in stored if n.startswith(_PREFIX)}
    load_tensors(module, tensors, path)
    return LoadedNetwork(**vars(described), module=module.eval(), trust=tuple(trust))


def read_description(path: Path) -> NetworkDescription | None:
    """Read the description of the network in a checkpoint or a safetensors file.

    Args:
        path: File.

    Returns:
        Description of the network; None for files of other programs, such as a state dict.

    Raises:
        DataError: The file is missing, or its description cannot be used.
    """
    if path.suffix.lower() == ".safetensors":
        try:
            with safe_open(path, framework="pt") as file:
                content = (file.metadata() or {}).get(METADATA_KEY)
        except (SafetensorError, OSError) as error:
            raise DataError(path, found=first_line(error), expected=_EXPECTED) from error
    else:
        checkpoint = load_plain(path, _EXPECTED, mmap=True)
        content = checkpoint.get(METADATA_KEY) if isinstance(checkpoint, Mapping) else None
    return _parsed(path, content)


def _parsed(path: Path, content: Any) -> NetworkDescription | None:
    if content is None:
        return None
    try:
        fields = json.loads(content) if isinstance(content, str) else dict(content)
        fields.pop("tangent_train_version", None)
        return NetworkDescription(**fields)
    except (ValueError, TypeError, RecursionError) as error:
        invalid = isinstance(error, pydantic.ValidationError)
        reason = wrong_field(error) if invalid else first_line(error)
        raise DataError(
            path,
            found=f"a description of the network that cannot be used ({reason})",
            expected=_EXPECTED,
            remedy="tangent-import describes a network of another program.",
        ) from error


def write_onnx_description(source: Path, path: Path, described: NetworkDescription) -> None:
    """Write an ONNX file with all weights and the description of its network.

    Args:
        source: ONNX file; its weights may be in other files of its folder.
        path: File to write.
        described: Network that the ONNX file computes.

    Raises:
        DataError: The weights are behind links, or larger than one ONNX file can be.
    """
    import onnx

    try:
        graph = onnx.load(source, format="protobuf")
        entries = {entry.key: entry.value for entry in graph.metadata_props}
        onnx.helper.set_model_props(graph, entries | {METADATA_KEY: json.dumps(described.plain())})
        content = graph.SerializeToString()
    except Exception as error:  # onnx and protobuf raise kinds of their own
        expected = "weights in the file, or in a copy (not a link) beside it, below 2 GB"
        raise DataError(source, found=first_line(error), expected=expected) from error
    path.write_bytes(content)
