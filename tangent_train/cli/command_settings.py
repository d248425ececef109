"""Settings of the commands, checked before torch is imported.

Importing this module takes a few hundredths of a second; importing a command takes seconds.
"""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import datamodules
from tangent_train.checkpoints.kinds import Align, DepthKind, ScoreKind
from tangent_train.cli.settings import names_of, parse_settings
from tangent_train.errors import DataError


def check_settings(command: str, config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Refuse settings of a wrong type, and inputs that do not exist.

    Args:
        command: Name of the command, e.g. predict.
        config: Composed config of the command, resolved.
        overrides: Settings that the user typed. A data folder that is not among them, such as one
            from an experiment, is checked later by its data set.

    Raises:
        DataError: A file or folder is missing.
        SettingError: A setting has another type.
    """
    kind = SETTINGS[command]
    settings = parse_settings(kind, config)
    for one in fields(kind):
        value = getattr(settings, one.name)
        if value is not None and "check" in one.metadata:
            one.metadata["check"](one.name, value)
    images = ("left", "right", "input") if command == "keypoints" else ()
    if any(config[name] is not None for name in images):
        return  # images take the place of the data set
    typed_names = names_of(overrides)
    for prefix, section in (("", config), ("photos.", config.get("photos") or {})):
        data = section.get("data") or {}
        root, mask = Path(str(data.get("root"))), data.get("mask")
        is_missing = f"{prefix}data.root" in typed_names and not root.is_dir()
        if is_missing and datamodules.is_read(str(data.get("_target_"))):
            raise DataError(
                root,
                found="no such folder",
                expected="the folder of the data set",
                remedy="Give data.root=<folder>.",
            )
        if isinstance(mask, str):
            _check_exists("data.mask", Path(mask))


def _check_exists(name: str, value: Any) -> None:
    if isinstance(value, Path) and not value.exists():
        expected = f"{name}=<a file or folder>"
        raise DataError(value, found="no such file or folder", expected=expected)


def _check_pattern(name: str, value: Any) -> None:
    path = Path(value)
    if not path.exists() and next(glob.iglob(str(path), recursive=True), None) is None:  # noqa: PTH207
        expected = f"{name}=<an image, a folder of images or a pattern such as 'holiday/*.jpg'>"
        raise DataError(value, found="nothing", expected=expected)


def _check_label_map(name: str, value: Any) -> None:
    if str(value).lower().endswith(".json"):
        _check_exists(name, Path(value))


_EXISTS = {"check": _check_exists}
_IMAGES = {"check": _check_pattern}
_CLASS_MAP = {"check": _check_label_map}


@dataclass(frozen=True)
class InputSettings:
    """Settings of a command that takes images and videos.

    Attributes:
        input: Images, see `tangent_train.io.image_files.image_paths`.
        area: Part of the sphere that panoramas show, see `area_of_angles`; None for the part that
            their GPano tags name.
        every: Step between the frames of a video: 1 for all, n for the first and every n-th one.
    """

    input: str | Path | None = field(metadata=_IMAGES)
    area: tuple[float, ...] | None
    every: int


@dataclass(frozen=True)
class PredictSettings(InputSettings):
    """See ``configs/predict.yaml``."""

    checkpoint: Path = field(metadata=_EXISTS)
    input: str | Path = field(metadata=_IMAGES)
    output: Path
    label_map: str | Path | None = field(metadata=_CLASS_MAP)
    unmapped: Literal["unknown", "never"]
    depth: Path | None = field(metadata=_EXISTS)
    depth_scale: float
    projection: Literal["equirectangular", "perspective"]
    fov: float | None
    views: str | dict[str, Any] | None
    levels: tuple[int, ...] | None
    base_level: int | None
    blend: Literal["feather", "nearest"]
    rotations: int
    fill: Literal["black", "mean", "edge", "reflect"] | None
    upright: Literal["pose", "auto"] | None
    max_tilt_deg: float
    mask: float | Path | None = field(metadata=_EXISTS)
    min_confidence: float
    min_share: float
    align: Align | None
    write: tuple[str, ...] | None
    depth_format: Literal["png", "npy", "exr"] | None
    points: int | None
    report: int
    overwrite: bool
    resume: bool
    shard: str | int | None
    view_batch_size: int | None
    device: str
    trust: tuple[str, ...]


@dataclass(frozen=True)
class RenderSettings(InputSettings):
    """See ``configs/render.yaml``."""

    output: Path | None
    overwrite: bool
    views: str | dict[str, Any] | None
    base_level: int | None
    level: int | None
    dim: int | None
    faces: tuple[int, ...] | None
    rotation: tuple[float, float, float] | None
    format: str
    interpolation: Literal["bilinear", "nearest"]
    colmap: bool
    mask: float | Path | None = field(metadata=_EXISTS)
    mask_classes: tuple[str, ...] | None
    figure: Path | None
    back: Path | None = field(metadata=_EXISTS)
    poses: Path | None = field(metadata=_EXISTS)
    cameras: Path | None = field(metadata=_EXISTS)
    blend: Literal["feather", "nearest"]
    height: int | None
    kind: Literal["auto", "color", "labels", "depth", "features"]
    z_depth: bool


@dataclass(frozen=True)
class ExportSettings:
    """See ``configs/export.yaml``."""

    checkpoint: Path = field(metadata=_EXISTS)
    output: Path
    image_size: tuple[int, int] | None
    opset: int | None
    overwrite: bool
    trust: tuple[str, ...]


@dataclass(frozen=True)
class ImportSettings:
    """See ``configs/import.yaml``; `normalization` may also be a mapping."""

    network: str
    model: str | Path | None
    weights: str | Path | None
    file: Path | None = field(metadata=_EXISTS)
    classes: Path | None = field(metadata=_EXISTS)
    unknown_classes: tuple[str, ...]
    unknown_wins: bool
    scores: ScoreKind | None
    depth: DepthKind | None
    image_size: tuple[int, ...] | None
    views: str | dict[str, Any] | None
    levels: tuple[int, ...] | None
    base_level: int | None
    fov: float
    output: Path
    overwrite: bool


@dataclass(frozen=True, kw_only=True)
class KeypointSettings:
    """Settings of ``configs/keypoints.yaml``, except for the fields of `Comparer`."""

    data: dict[str, Any] | None = None
    output: Path
    left: Path | None = field(metadata=_EXISTS)
    right: Path | None = field(metadata=_EXISTS)
    input: str | Path | None = field(metadata=_IMAGES)
    max_pairs: int | None
    pictures: int
    export: bool


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of every run, see ``configs/train.yaml``."""

    data: dict[str, Any]
    representation: dict[str, Any]
    network: dict[str, Any]
    task: dict[str, Any]
    optimizer: dict[str, Any]
    scheduler: dict[str, Any] | None = None
    trainer: dict[str, Any]
    logger: dict[str, Any] | None = None
    callbacks: dict[str, Any] | None = None
    seed: int
    level: int
    panels: int
    validation_images: int
    checkpoint_every_n_steps: int | None
    ema: float | None


@dataclass(frozen=True, kw_only=True)
class TrainSettings(RunSettings):
    """See ``configs/train.yaml``; `name` may contain folders."""

    name: str | Path
    init_from: Path | None = field(metadata=_EXISTS)
    resume: Path | None = field(metadata=_EXISTS)


@dataclass(frozen=True)
class LabelMapSettings:
    """Label map of an evaluation, see ``configs/evaluate.yaml``."""

    label_map: str | Path
    unmapped: Literal["unknown", "never"]


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(RunSettings):
    """See ``configs/evaluate.yaml``; a stage of a transfer may lack a label map."""

    network: dict[str, Any] | None = None  # type: ignore[assignment]
    checkpoint: Path = field(metadata=_EXISTS)
    label_map: str | Path | None = field(default=None, metadata=_CLASS_MAP)


@dataclass(frozen=True, kw_only=True)
class TransferSettings(EvaluateSettings):
    """See ``configs/transfer.yaml``."""

    network: dict[str, Any] = field()
    checkpoint: Path | None = field(metadata=_EXISTS)  # type: ignore[assignment]


SETTINGS: Mapping[str, type[Any]] = {
    "check": RunSettings,
    "evaluate": EvaluateSettings,
    "export": ExportSettings,
    "import": ImportSettings,
    "keypoints": KeypointSettings,
    "predict": PredictSettings,
    "prepare": RunSettings,
    "render": RenderSettings,
    "train": TrainSettings,
    "transfer": TransferSettings,
}
