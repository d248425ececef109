"""``tangent-predict``: predict labels or depth of panoramas and photos."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.cli.input_files import Inputs, is_video
from tangent_train.cli.jobs import Job, Shard, run_jobs
from tangent_train.cli.predict_kinds import Prediction
from tangent_train.cli.predict_shards import PredictionShard
from tangent_train.cli.settings import check_unread
from tangent_train.config.settings import PredictSettings
from tangent_train.console import print_text
from tangent_train.errors import SettingError, counted
from tangent_train.heads import PredictedImage
from tangent_train.heads.pictures import evenly_spread
from tangent_train.inference.images import DepthFolder, InputImage, read_panorama, read_photo
from tangent_train.inference.views import PanoramaViews, PhotoViews
from tangent_train.io.masks import Masks
from tangent_train.io.tangent_folders import panorama_area
from tangent_train.results.html import EncodedImage
from tangent_train.results.predictions import (
    Entry,
    PredictionFolder,
    encode_prediction,
    is_result_in,
)

_DECISIVE = (
    "checkpoint", "label_map", "unmapped", "depth_scale", "projection", "area", "fov", "views",
    "levels", "base_level", "blend", "rotations", "fill", "upright", "max_tilt_deg", "mask",
    "min_confidence", "min_share", "align", "depth_format", "points", "every",
)  # fmt: skip
"""Settings that results depend on: resuming requires the same values."""

_COUNTED_IMAGES = 32
"""Images whose confidences are counted for `min_share`, at most."""

_SAVED_EVERY_S = 10.0
"""Time between summaries: work that may be lost when a process is killed."""


def predict(settings: PredictSettings) -> None:
    """Predict the labels of images and write them.

    Args:
        settings: Settings of the command.

    Raises:
        SettingError: A setting is missing or invalid.
        DataError: The checkpoint cannot be read, or no images are found.
    """
    _check_unread(settings)
    decisive = settings.model_dump(mode="json", include=set(_DECISIVE))
    inputs, shard = _inputs(settings), Shard.parse(settings.shard)
    trained = load_network(settings.checkpoint, settings.trust)
    views = _views(settings, trained)
    prediction = Prediction(settings, trained, views)
    if isinstance(views, PanoramaViews):
        print_text(f"A panorama is predicted in {views.description(settings.area)}.")
    head = prediction.head
    folder = PredictionFolder(settings.output, head, head.file_kinds(settings.write))
    _check_videos(inputs, folder)
    names = inputs.names()
    shown: dict[str, Any] = {names[n]: None for n in evenly_spread(settings.report, len(names))}
    depth = _depth_folder(settings, trained)
    images = _Images(settings, prediction, folder, depth, Masks(settings.mask), shown)
    prediction.prepare(images.examples(inputs))
    if shard is None:
        entries = done = _predict(settings, decisive, inputs, images)
    else:
        shared = {**decisive, "write": list(folder.kinds)}
        part = PredictionShard(shard, settings.output / "shards", list(inputs.files), shared)
        done = _predict(settings, decisive, inputs.part(shard), images, part)
        part.save(done, done=True)
        count, entries = part.finished()
        print_text(f"Shard {shard} is done: {count} of {shard.count} in all.")
        if count == shard.count:
            folder.write_summary(decisive, entries)
        else:
            entries = []
    if predicted := folder.predicted(entries):
        if pictures := images.pictures(inputs, {entry["name"] for entry in predicted}):
            folder.write_page(entries, pictures)
        folder.table(predicted).print()
        print_text(f"Results are in {settings.output}.")
    if failed := sum("error" in entry for entry in done):
        sys.exit(f"tangent-predict: {failed} of {len(done)} images could not be used, see above")


def _predict(
    settings: PredictSettings,
    decisive: Mapping[str, Any],
    inputs: Inputs,
    images: _Images,
    part: PredictionShard | None = None,
) -> list[Entry]:
    """Predict all images, or those of a shard; return their entries and those of earlier runs."""
    folder, summary = images.folder, None if part is None else part.path
    known = folder.earlier(decisive, summary) if settings.resume else None
    if not (settings.overwrite or known is not None or (part and part.folder.exists())):
        folder.check(resume=settings.resume)
    earlier = known or {}
    names = dict.fromkeys(inputs.names())
    entries = [entry for name, entry in earlier.items() if name in names]
    save = partial(folder.write_summary, decisive, entries)
    if part is not None:
        part.begin(entries, resume=settings.resume, overwrite=settings.overwrite)
        save = partial(part.save, entries)
    count = len(names)
    print_text(f"{counted(count, 'images')}, {len(entries)} done already.")
    missing = count - len(entries)
    steps = images.predict, images.read, images.write
    worked = set()
    saved = -math.inf
    save()
    try:
        with closing(run_jobs("Predicting", inputs.missing(earlier), missing, *steps)) as done:
            for job in done:
                entry = {"error": job.error} if job.error else job.value
                entries.append({"file": str(job.path), "name": job.item, **entry})
                worked.add(job.path)
                if time.monotonic() - saved > _SAVED_EVERY_S:
                    save()
                    saved = time.monotonic()
    except KeyboardInterrupt:
        print_text(f"{len(entries)} of {count} images are done. Continue with resume=true.")
        raise
    finally:
        save()
        if part is None and not folder.predicted(entries):
            folder.remove_summary()
    if unmade := _make_videos(inputs, folder, entries, worked):
        entries += unmade
        save()
    return entries


@dataclass(frozen=True)
class _Images:
    """Reads images, predicts them and writes the results.

    Attributes:
        settings: Settings of the command.
        prediction: Predicts one image.
        folder: Output folder.
        depth: Depth images, for networks that take depth.
        masks: Masks of panoramas.
        shown: Images of the report by name; None until they are predicted.
    """

    settings: PredictSettings
    prediction: Prediction
    folder: PredictionFolder
    depth: DepthFolder | None
    masks: Masks
    shown: dict[str, EncodedImage | None]

    def examples(self, inputs: Inputs) -> Iterator[Callable[[], InputImage]]:
        """Yield functions that read some of all images."""
        names = inputs.names()
        chosen = {names[number] for number in evenly_spread(_COUNTED_IMAGES, len(names))}
        print_text(f"Confidences are counted in {counted(len(chosen), 'images')}.")
        for job in inputs.missing(set(names) - chosen):
            if not job.error:
                yield partial(self.read, job)

    def read(self, job: Job) -> InputImage:
        """Read one image."""
        settings, image = self.settings, job.path if job.value is None else job.value()
        stem = job.item.removesuffix(job.path.suffix)
        depth = None if self.depth is None else partial(self.depth.read, stem)
        if settings.projection == "perspective":
            return read_photo(image, settings.fov, depth)
        return read_panorama(image, settings.area, settings.upright, depth)

    def predict(self, job: Job, progress: Callable[[float], object]) -> PredictedImage:
        """Predict one image."""
        return self.prediction(job.value, self.folder.files(job.item), progress)

    def write(self, job: Job) -> Entry:
        """Write the results of one image; return its entry in the summary."""
        predicted: PredictedImage = job.value
        image, pixels, _ = predicted
        is_counted = np.array(True)
        if image.area is not None:
            is_counted = image.cut(self.masks.read(job.item, image.area)) > 0
            unknown = pixels.dtype.type(self.folder.head.unknown)
            predicted = predicted._replace(pixels=np.where(is_counted, pixels, unknown))
        folder = self.folder.of_frames if is_video(job.path) else self.folder
        folder.head.write(folder.files(job.item), predicted)
        rows, columns = pixels.shape
        entry: Entry = {"rows": rows, "columns": columns}
        if is_video(job.path):
            entry["frame"] = int(job.item.rpartition("/")[2])
        if image.up is not None:
            entry["tilt_deg"] = round(math.degrees(math.acos(np.clip(image.up[2], -1, 1))), 2)
        entry[folder.head.summary] = folder.head.summarize(predicted, is_counted)
        if job.item in self.shown:
            self.shown[job.item] = encode_prediction(folder.head, job.item, predicted)
        return entry

    def pictures(self, inputs: Inputs, used: Set[str]) -> list[EncodedImage]:
        """Return the pictures of the report; results of other processes are read again.

        Args:
            inputs: All images and videos.
            used: Names of the predicted images and frames.
        """
        count, names = self.settings.report, [name for name in inputs.names() if name in used]
        wanted = [names[number] for number in evenly_spread(count, len(names))]
        earlier = {name for name in wanted if self.shown.get(name) is None}
        head = self.folder.head
        for job in inputs.missing(set(inputs.names()) - earlier):
            file = self.folder.files(job.item).get(head.source)
            if file is not None and not job.error:
                predicted = PredictedImage(self.read(job), head.read(file))
                self.shown[job.item] = encode_prediction(head, job.item, predicted)
        encoded = {name: picture for name, picture in self.shown.items() if picture is not None}
        available = [name for name in dict.fromkeys((*wanted, *self.shown)) if name in encoded]
        return [encoded[name] for name in names if name in available[:count]]


def _make_videos(
    inputs: Inputs, folder: PredictionFolder, entries: Sequence[Entry], worked: set[Path]
) -> list[Entry]:
    """Write the result videos of videos whose frames are all done; return errors as entries."""
    failed = {entry["file"] for entry in entries if "error" in entry}
    videos = [job for job in inputs.videos.values() if str(job.path) not in failed]

    def write(job: Job, _: Callable[[float], object]) -> None:
        again, frames = job.path in worked, [e for e in entries if e["file"] == str(job.path)]
        folder.write_videos(job.item, job.path, job.value, inputs.every, frames, again=again)

    done = run_jobs("Making videos", videos, len(videos), write)
    return [{"file": str(j.path), "name": j.item, "error": j.error} for j in done if j.error]


def _inputs(settings: PredictSettings) -> Inputs:
    """Find the images and videos."""

    def check_size(path: Path, size: tuple[int, int]) -> None:
        if settings.projection == "equirectangular":
            panorama_area(path, size, settings.area)

    return Inputs.find(settings, is_result_in(settings.output), check_size)


def _check_videos(inputs: Inputs, folder: PredictionFolder) -> None:
    source, pictures = folder.head.source, {*folder.kinds}.difference(folder.of_frames.kinds)
    if inputs.videos and pictures and source not in folder.kinds:
        raise SettingError(
            "write",
            found=f"{' and '.join(sorted(pictures))} of a video without {source}",
            expected=f"{source} too: videos of pictures are made from the {source} of all frames",
        )


def _views(settings: PredictSettings, trained: LoadedNetwork) -> PanoramaViews | PhotoViews:
    how = settings.levels, settings.base_level, settings.blend, settings.rotations
    if settings.projection == "perspective":
        return PhotoViews(trained, *how)
    return PanoramaViews(trained, *how, settings.views, settings.fill)


def _check_unread(settings: PredictSettings) -> None:
    """Refuse settings that nothing reads beside the others."""
    if settings.projection == "perspective":
        of_panoramas = dict.fromkeys(("area", "fill", "mask", "upright", "views"))
        check_unread(settings, "for photos", **of_panoramas)
    else:
        check_unread(settings, "without projection=perspective", fov=None)
    if settings.upright != "auto":
        check_unread(settings, "without upright=auto", max_tilt_deg=60)
    if settings.label_map is None:
        check_unread(settings, "without label_map", unmapped="unknown")


def _depth_folder(settings: PredictSettings, trained: LoadedNetwork) -> DepthFolder | None:
    folder, wanted = settings.depth, "depth" in trained.inputs
    if wanted != (folder is not None) or (folder is not None and not folder.is_dir()):
        raise SettingError(
            "depth",
            found=folder or "none",
            expected=f"{'a folder of depth images' if wanted else 'null'} for a network that "
            f"takes {' and '.join(trained.inputs)}",
        )
    return None if folder is None else DepthFolder(folder, settings.depth_scale)
