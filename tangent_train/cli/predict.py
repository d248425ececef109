"""``tangent-predict``: label maps of the user's own panoramas and photos."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from datamodules.images.image_files import image_paths, short_names
from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli.each import each
from tangent_train.cli.settings import typed
from tangent_train.errors import SettingError, counted
from tangent_train.inference.class_maps import Unmapped, load_class_map, map_classes
from tangent_train.inference.images import DepthFolder, read_panorama, read_photo
from tangent_train.inference.judge import NetworkJudge
from tangent_train.inference.predictor import Predictor
from tangent_train.inference.views import PanoramaViews, PhotoViews
from tangent_train.results.predictions import (
    Entry,
    Kind,
    PredictionFolder,
    class_shares,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from datamodules.images.gpano import PanoramaArea
    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.inference.views import InputImage
    from tangent_train.results.html import EncodedImage

__all__ = ["predict"]

_DECISIVE = (
    "checkpoint", "class_map", "unmapped", "depth_scale", "projection", "crop", "fov", "level",
    "levels", "base_level", "blend", "rotations", "upright", "max_tilt_deg", "min_confidence",
)  # fmt: skip
"""Settings that labels depend on: those of resumed predictions must be the same."""

_SAVED_EVERY_S = 10.0
"""So much work is done again after a process was killed."""


@dataclass(frozen=True)
class Settings:
    """See ``configs/predict.yaml``."""

    checkpoint: Path
    input: str
    output: Path
    class_map: str | None
    unmapped: Unmapped
    depth: Path | None
    depth_scale: float
    projection: Literal["equirectangular", "perspective"]
    crop: tuple[float, ...] | None
    fov: float | None
    level: int | None
    levels: tuple[int, ...] | None
    base_level: int | None
    blend: Literal["feather", "nearest"]
    rotations: int
    upright: Literal["pose", "auto"] | None
    max_tilt_deg: float
    min_confidence: float
    write: tuple[Kind, ...]
    report: int
    overwrite: bool
    resume: bool
    images_per_forward: int | None
    device: str
    trust: tuple[str, ...]


def predict(config: Mapping[str, Any]) -> None:
    """Predict the labels of images and write them.

    Args:
        config: The composed ``predict.yaml``.

    Raises:
        SettingError: A setting is missing or invalid.
        DataError: The checkpoint cannot be read, or there are no images.
    """
    settings = typed(Settings, config)
    decisive = {name: config[name] for name in _DECISIVE}
    images = _find_images(settings)
    original, trained = _networks(settings)
    folder = PredictionFolder(settings.output, trained.class_names, settings.write)
    depth = _depth_folder(settings, trained)
    predictor = _predictor(settings, trained)
    judge = NetworkJudge.of(original, predictor.device)
    label = _Labeller(settings, trained, predictor, judge, depth, folder)
    earlier = folder.earlier(decisive) if settings.resume else {}
    if not (settings.overwrite or earlier):
        folder.check()
    entries = [entry for name, entry in earlier.items() if name in images]
    missing = {name: path for name, path in images.items() if name not in earlier}
    _say(f"{counted(len(images), 'images')}, {len(entries)} done already.")
    saved = -math.inf
    try:
        for name, entry, error in each("Predicting", missing, label):
            file = {"file": str(missing[name]), "name": name}
            entries.append(file | (entry or {"error": error}))
            if time.monotonic() - saved > _SAVED_EVERY_S:
                _save(folder, decisive, entries)
                saved = time.monotonic()
    except KeyboardInterrupt:
        _say(f"{len(entries)} of {len(images)} images are done. resume=true continues.")
        raise
    finally:
        _save(folder, decisive, entries)
    if label.shown:
        folder.write_page(entries, label.shown)
    failed = sum("error" in entry for entry in entries)
    if failed < len(entries):
        _say(folder.mean_shares(entries).terminal())
        _say(f"Results are in {settings.output}.")
    if failed:
        sys.exit(f"tangent-predict: {failed} of {len(entries)} images could not be used, see above")


@dataclass(frozen=True)
class _Labeller:
    """Predicts the labels of one image and writes them.

    Attributes:
        settings: Of the command.
        trained: The network.
        predictor: Labels images with it.
        judge: Tells with it which way is up.
        depth: Depth images, for networks that take depth.
        folder: Output folder.
        shown: Images for the report: the first ones done.
    """

    settings: Settings
    trained: TrainedNetwork
    predictor: Predictor
    judge: NetworkJudge
    depth: DepthFolder | None
    folder: PredictionFolder
    shown: list[EncodedImage] = field(default_factory=list)

    def __call__(self, name: str, path: Path, progress: Callable[[float], object]) -> Entry:
        """Label one image and return its entry of the summary."""
        image, area = self._read(name.removesuffix(path.suffix), path)
        probabilities = "probabilities" in self.settings.write
        scores = self.predictor.predict(image, progress, probabilities=probabilities)
        rgb, labels = image.rgb, self.trained.labels(scores.labels())
        if area is not None:
            rgb, labels = area.cut(rgb), area.cut(labels)
        self.folder.write(name, rgb, labels, scores, area)
        if len(self.shown) < self.settings.report:
            self.shown.append(self.folder.viewer_image(name, rgb, labels, area))
        rows, columns = labels.shape
        entry: Entry = {"rows": rows, "columns": columns}
        if image.up is not None:
            entry["tilt_deg"] = round(math.degrees(math.acos(np.clip(image.up[2], -1, 1))), 2)
        return entry | {"classes": class_shares(labels, self.folder.class_names, image, area)}

    def _read(self, name: str, path: Path) -> tuple[InputImage, PanoramaArea | None]:
        given = self.settings
        if given.projection == "perspective":
            return read_photo(path, name, self.depth, given.fov), None
        how = given.crop, given.upright, given.max_tilt_deg
        return read_panorama(path, name, self.depth, *how, self.judge)


def _save(folder: PredictionFolder, settings: Mapping[str, Any], entries: list[Entry]) -> None:
    if any("classes" in entry for entry in entries):  # else nothing is in the way of another try
        folder.write_summary(settings, entries)


def _networks(settings: Settings) -> tuple[TrainedNetwork, TrainedNetwork]:
    """The network with its own classes, and with those of the class map."""
    if settings.class_map is None:
        return (load_trained(settings.checkpoint, settings.trust),) * 2
    class_map = load_class_map(settings.class_map)
    trained = load_trained(settings.checkpoint, settings.trust)
    mapped = map_classes(trained, class_map, settings.unmapped)
    _say(f"Class map {class_map.name}: {mapped}.")
    return trained, mapped.trained


def _find_images(settings: Settings) -> dict[str, Path]:
    """The images by name, without results of this command in its output folder."""
    results = [(settings.output / kind).resolve() for kind in ("labels", "color", "overlay")]
    paths = [
        path
        for path in image_paths(settings.input)
        if not any(path.resolve().is_relative_to(folder) for folder in results)
    ]
    if not paths:
        raise SettingError("input", found=f"only results in {settings.output}", expected="images")
    return dict(zip(short_names(paths), paths, strict=True))


def _predictor(settings: Settings, trained: TrainedNetwork) -> Predictor:
    how = settings.base_level, settings.blend
    levels = settings.levels or (settings.level,)
    views: PhotoViews | PanoramaViews
    if settings.projection == "perspective":
        views = PhotoViews(trained, settings.level, *how)
    else:
        upright = settings.upright is not None
        views = PanoramaViews(trained, levels, *how, settings.rotations, upright=upright)
    of_forward = settings.device, settings.images_per_forward
    return Predictor(trained, views, *of_forward, settings.min_confidence)


def _depth_folder(settings: Settings, trained: TrainedNetwork) -> DepthFolder | None:
    folder, wanted = settings.depth, "depth" in trained.inputs
    if wanted != (folder is not None) or (folder is not None and not folder.is_dir()):
        raise SettingError(
            "depth",
            found=folder or "none",
            expected=f"{'a folder of depth images' if wanted else 'null'} for a network that "
            f"takes {' and '.join(trained.inputs)}",
        )
    return None if folder is None else DepthFolder(folder, settings.depth_scale)


def _say(content: str | Table) -> None:
    Console(soft_wrap=True, highlight=False).print(content, markup=False)
