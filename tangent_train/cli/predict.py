"""``tangent-predict``: predict the labels of panoramas and photos."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.images.gpano import PanoramaArea
from datamodules.images.masks import Masks
from datamodules.images.pixel_files import read_pixels
from datamodules.images.tangent_folders import panorama_area
from tangent_train.checkpoints.trained import TrainedNetwork, load_trained
from tangent_train.cli.command_settings import PredictSettings
from tangent_train.cli.input_files import Inputs, is_video
from tangent_train.cli.jobs import Job, Shard, run_jobs
from tangent_train.cli.predict_shards import PredictionShard
from tangent_train.cli.settings import parse_settings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, counted
from tangent_train.inference.class_maps import load_class_map, map_classes
from tangent_train.inference.confidences import class_thresholds, count_confidences
from tangent_train.inference.engine import Predictor
from tangent_train.inference.images import (
    DepthFolder,
    InputImage,
    read_panorama,
    read_photo,
    with_up,
)
from tangent_train.inference.judge import NetworkJudge
from tangent_train.inference.representations import PanoramaViews, PhotoViews
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.results.html import EncodedImage
from tangent_train.results.pictures import evenly_spread
from tangent_train.results.predictions import (
    Entry,
    LabeledImage,
    PredictionFolder,
    class_shares,
    is_result_in,
)

_DECISIVE = (
    "checkpoint", "class_map", "unmapped", "depth_scale", "projection", "area", "fov", "views",
    "levels", "base_level", "blend", "rotations", "fill", "upright", "max_tilt_deg", "mask",
    "min_confidence", "min_share", "every",
)  # fmt: skip
"""Settings that results depend on: resuming requires the same values."""

_COUNTED_IMAGES = 32
"""Images whose confidences are counted for `min_share`, at most."""

_SAVED_EVERY_S = 10.0
"""Time between summaries: work that may be lost when a process is killed."""


def predict(config: Mapping[str, Any]) -> None:
    """Predict the labels of images and write them.

    Args:
        config: Composed ``predict.yaml``.

    Raises:
        SettingError: A setting is missing or invalid.
        DataError: The checkpoint cannot be read, or no images are found.
    """
    settings = parse_settings(PredictSettings, config)
    _check_projection(settings)
    _check_confidence(settings)
    decisive = {name: config[name] for name in _DECISIVE}
    inputs, shard = _inputs(settings), Shard.parse(settings.shard)
    original, trained = _networks(settings)
    folder = PredictionFolder(settings.output, trained.class_names, settings.write)
    names = inputs.names()
    shown = [names[number] for number in evenly_spread(settings.report, len(names))]
    label = _Labeler(settings, original, trained, folder, shown)
    if settings.min_share:
        label.find_thresholds(inputs)
    if shard is None:
        done = _label(settings, decisive, inputs, label, folder)
        _finish(settings, inputs, label, folder, done)
    else:
        shared = {**decisive, "write": list(settings.write)}
        part = PredictionShard(shard, settings.output / "shards", list(inputs.files), shared)
        done = _label(settings, decisive, inputs.part(shard), label, folder, part)
        part.save(done, done=True)
        count, entries = part.finished()
        print_text(f"Shard {shard} is done: {count} of {shard.count} in all.")
        if count == shard.count:
            folder.write_summary(decisive, entries)
            _finish(settings, inputs, label, folder, entries)
    if failed := sum("error" in entry for entry in done):
        sys.exit(f"tangent-predict: {failed} of {len(done)} images could not be used, see above")


def _label(
    settings: PredictSettings,
    decisive: Mapping[str, Any],
    inputs: Inputs,
    label: _Labeler,
    folder: PredictionFolder,
    part: PredictionShard | None = None,
) -> list[Entry]:
    """Label all images, or those of a shard; return their entries and those of earlier runs."""
    summary = None if part is None else part.path
    known = folder.earlier(decisive, summary) if settings.resume else None
    if not (settings.overwrite or known is not None or (part and part.folder.exists())):
        folder.check(resume=settings.resume)
    earlier = known or {}
    names = dict.fromkeys(inputs.names())
    entries = [entry for name, entry in earlier.items() if name in names]
    if part is not None:
        part.begin(entries, resume=settings.resume, overwrite=settings.overwrite)

    def save() -> None:
        if part is not None:
            part.save(entries)
        else:
            folder.write_summary(decisive, entries)

    count = len(names)
    print_text(f"{counted(count, 'images')}, {len(entries)} done already.")
    missing = count - len(entries)
    steps = label, label.read, label.write
    labeled = set()
    saved = -math.inf
    save()
    try:
        with closing(run_jobs("Predicting", inputs.missing(earlier), missing, *steps)) as done:
            for job in done:
                entry = {"error": job.error} if job.error else job.value
                entries.append({"file": str(job.path), "name": job.item, **entry})
                labeled.add(job.path)
                if time.monotonic() - saved > _SAVED_EVERY_S:
                    save()
                    saved = time.monotonic()
    except KeyboardInterrupt:
        print_text(f"{len(entries)} of {count} images are done. Continue with resume=true.")
        raise
    finally:
        save()
        if part is None and not any("classes" in entry for entry in entries):
            folder.remove_summary()
    if unmade := _make_videos(inputs, folder, entries, labeled):
        entries += unmade
        save()
    return entries


def _finish(
    settings: PredictSettings,
    inputs: Inputs,
    label: _Labeler,
    folder: PredictionFolder,
    entries: Sequence[Entry],
) -> None:
    """Write the report and print the shares of the classes."""
    used = {entry["name"] for entry in entries if "classes" in entry}
    if not used:
        return
    pictures = label.pictures(inputs, used)
    if pictures:
        folder.write_page(entries, pictures)
    folder.mean_shares(entries).print()
    print_text(f"Results are in {settings.output}.")


class _Labeler:
    """Reads images, predicts their labels and writes them.

    Args:
        settings: Settings of the command.
        original: Network with its original classes, which estimates the up direction.
        trained: Network with mapped classes, which predicts the labels.
        folder: Output folder.
        shown: Names of the images in the report.
    """

    def __init__(
        self,
        settings: PredictSettings,
        original: TrainedNetwork,
        trained: TrainedNetwork,
        folder: PredictionFolder,
        shown: Sequence[str],
    ) -> None:
        self._settings, self._trained, self._folder = settings, trained, folder
        self._predictor = _predictor(settings, trained)
        self._judge = NetworkJudge(original, self._predictor.device)
        self._depth = _depth_folder(settings, trained)
        self._masks = Masks(settings.mask)
        self._shown: dict[str, EncodedImage | None] = dict.fromkeys(shown)
        self._thresholds: NDArray[np.float64] | None = None

    def find_thresholds(self, inputs: Inputs) -> None:
        """Find the confidence that each class needs, see `min_share`; some images are predicted.

        Args:
            inputs: All images, also those of other shards.
        """
        settings, names = self._settings, inputs.names()
        chosen = {names[number] for number in evenly_spread(_COUNTED_IMAGES, len(names))}
        num_classes = len(self._trained.class_names) - 1
        counts = np.zeros((num_classes + 1, 1), np.int64)
        print_text(f"Confidences are counted in {counted(len(chosen), 'images')}.")
        for job in inputs.missing(set(names) - chosen):
            with suppress(DataError, SettingError):  # reported when the image is labeled
                if not job.error:
                    image, area = self.read(job)
                    _, scores = self._scores(image, area)
                    maps: list[Any] = [self._trained.labels(scores.labels()), scores.confidences()]
                    labels, confidences = maps if area is None else [area.cut(m) for m in maps]
                    counts = counts + count_confidences(labels, confidences, num_classes)
        self._thresholds = class_thresholds(counts, settings.min_confidence, settings.min_share)
        least = zip(self._trained.class_names[1:], self._thresholds[1:], strict=True)
        listed = ", ".join(f"{name} {confidence:.2f}" for name, confidence in least)
        print_text(f"Smallest confidence of each class: {listed}.")

    def read(self, job: Job) -> tuple[InputImage, PanoramaArea | None]:
        """Read one image; return it with the area of a panorama, or with None for a photo."""
        settings, image = self._settings, job.path if job.value is None else job.value()
        stem = job.item.removesuffix(job.path.suffix)
        depth = None if self._depth is None else partial(self._depth.read, stem)
        if settings.projection == "perspective":
            return read_photo(image, settings.fov, depth), None
        return read_panorama(image, settings.area, settings.upright, depth)

    def __call__(self, job: Job, progress: Callable[[float], object]) -> LabeledImage:
        """Predict the labels of one image."""
        image, area = job.value
        image, scores = self._scores(image, area, progress)
        # Not written in another thread: scores take much memory.
        self._folder.write_probabilities(job.item, scores, area)
        labels = self._trained.labels(scores.labels())
        if self._thresholds is not None:
            is_sure = scores.confidences() >= self._thresholds[labels]
            labels = np.where(is_sure, labels, labels.dtype.type(0))
        return LabeledImage(image, labels if area is None else area.cut(labels), area)

    def _scores(
        self,
        image: InputImage,
        area: PanoramaArea | None,
        progress: Callable[[float], object] = lambda share: None,
    ) -> tuple[InputImage, ScoreMosaic]:
        """Predict the scores of one image; return it with its up direction."""
        if self._settings.upright == "auto" and area is not None:
            image = with_up(image, self._settings.max_tilt_deg, self._judge)
        keeps_sums = self._settings.min_share > 0 or "probabilities" in self._settings.write
        return image, self._predictor.predict(image, progress, probabilities=keeps_sums)

    def write(self, job: Job) -> Entry:
        """Write the labels of one image; return its entry in the summary."""
        image, labels, area = labeled = job.value
        is_counted = np.array(True)
        if area is not None:
            is_counted = area.cut(self._masks.read(job.item, area)) > 0
            labels = np.where(is_counted, labels, labels.dtype.type(0))
            labeled = LabeledImage(image, labels, area)
        folder = self._folder.of_frames if is_video(job.path) else self._folder
        folder.write(job.item, labeled)
        rows, columns = labels.shape
        entry: Entry = {"rows": rows, "columns": columns}
        if is_video(job.path):
            entry["frame"] = int(job.item.rpartition("/")[2])
        if image.up is not None:
            entry["tilt_deg"] = round(math.degrees(math.acos(np.clip(image.up[2], -1, 1))), 2)
        entry["classes"] = class_shares(labeled, self._folder.class_names, is_counted)
        if job.item in self._shown:
            self._shown[job.item] = self._folder.viewer_image(job.item, labeled)
        return entry

    def pictures(self, inputs: Inputs, used: Set[str]) -> list[EncodedImage]:
        """Return the pictures of the report; images labeled by other processes are read again.

        Args:
            inputs: All images and videos.
            used: Names of the labeled images and frames.
        """
        count, names = self._settings.report, [name for name in inputs.names() if name in used]
        wanted = [names[number] for number in evenly_spread(count, len(names))]
        earlier = {name for name in wanted if self._shown.get(name) is None}
        for job in inputs.missing(set(inputs.names()) - earlier):
            labels = self._folder.files(job.item).get("labels")
            if labels is not None and not job.error:
                image, area = self.read(job)
                labeled = LabeledImage(image, read_pixels(labels, indices=True), area)
                self._shown[job.item] = self._folder.viewer_image(job.item, labeled)
        others = [name for name in self._shown if name not in wanted]
        available = [name for name in (*wanted, *others) if self._shown.get(name) is not None]
        shown = (self._shown[name] for name in names if name in available[:count])
        return [picture for picture in shown if picture is not None]


def _make_videos(
    inputs: Inputs, folder: PredictionFolder, entries: Sequence[Entry], labeled: set[Path]
) -> list[Entry]:
    """Write the result videos of videos whose frames are all labeled; return errors as entries."""
    failed = {entry["file"] for entry in entries if "error" in entry}
    videos = [job for job in inputs.videos.values() if str(job.path) not in failed]

    def write(job: Job, _: Callable[[float], object]) -> None:
        again = job.path in labeled
        folder.write_videos(job.item, job.path, job.value, inputs.every, again=again)

    done = run_jobs("Making videos", videos, len(videos), write)
    return [{"file": str(j.path), "name": j.item, "error": j.error} for j in done if j.error]


def _networks(settings: PredictSettings) -> tuple[TrainedNetwork, TrainedNetwork]:
    """Return the network with its original classes, and with those of the class map."""
    if settings.class_map is None:
        return (load_trained(settings.checkpoint, settings.trust),) * 2
    class_map = load_class_map(settings.class_map)
    trained = load_trained(settings.checkpoint, settings.trust)
    mapped = map_classes(trained, class_map, settings.unmapped)
    print_text(f"Class map {class_map.name}: {mapped}.")
    return trained, mapped.trained


def _inputs(settings: PredictSettings) -> Inputs:
    """Find the images and videos."""

    def check_size(path: Path, size: tuple[int, int]) -> None:
        if settings.projection == "equirectangular":
            panorama_area(path, size, settings.area)

    inputs = Inputs.find(settings, is_result_in(settings.output), check_size)
    pictures = {"color", "overlay"}.intersection(settings.write)
    if inputs.videos and pictures and "labels" not in settings.write:
        raise SettingError(
            "write",
            found=f"{' and '.join(sorted(pictures))} of a video without labels",
            expected="labels too: videos of pictures are made from the labels of all frames",
        )
    return inputs


def _predictor(settings: PredictSettings, trained: TrainedNetwork) -> Predictor:
    how = settings.levels, settings.base_level, settings.blend, settings.rotations
    views: PanoramaViews | PhotoViews
    if settings.projection == "equirectangular":
        views = PanoramaViews(trained, *how, settings.views, settings.fill)
        print_text(f"A panorama is labeled in {views.description(settings.area)}.")
    else:
        views = PhotoViews(trained, *how)
    device, count = settings.device, settings.images_per_forward
    # With `min_share`, a threshold of each class replaces it.
    least = 0.0 if settings.min_share else settings.min_confidence
    return Predictor(trained, views, device, count, least)


def _check_confidence(settings: PredictSettings) -> None:
    if not 0 <= settings.min_share < 1:
        raise SettingError("min_share", found=settings.min_share, expected="0 to below 1")
    if settings.min_share and not 0 < settings.min_confidence <= 1:
        raise SettingError(
            "min_confidence",
            found=settings.min_confidence,
            expected="above 0 to 1 with min_share, which lowers it for single classes",
        )


def _check_projection(settings: PredictSettings) -> None:
    """Refuse settings of photos for panoramas, and of panoramas for photos."""
    is_photo = settings.projection == "perspective"
    others = ("area", "upright", "mask", "views") if is_photo else ("fov",)
    for name in others:
        if (found := getattr(settings, name)) is not None:
            expected = "null for photos" if is_photo else "null without projection=perspective"
            raise SettingError(name, found=found, expected=expected)


def _depth_folder(settings: PredictSettings, trained: TrainedNetwork) -> DepthFolder | None:
    folder, wanted = settings.depth, "depth" in trained.inputs
    if wanted != (folder is not None) or (folder is not None and not folder.is_dir()):
        raise SettingError(
            "depth",
            found=folder or "none",
            expected=f"{'a folder of depth images' if wanted else 'null'} for a network that "
            f"takes {' and '.join(trained.inputs)}",
        )
    return None if folder is None else DepthFolder(folder, settings.depth_scale)
