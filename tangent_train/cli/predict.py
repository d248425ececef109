"""``tangent-predict``: predict labels or depth of panoramas and photos."""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np

from datamodules.core.label_map import DISTANCE, PIXEL_CLASSES
from datamodules.folder.class_masks import mask_reader
from tangent_train.checkpoints.loaded import LoadedNetwork, load_network
from tangent_train.cli import main
from tangent_train.cli.one_scale import OneScale
from tangent_train.config.settings import PredictSettings, check_read
from tangent_train.console import print_text
from tangent_train.errors import SettingError, counted, listed
from tangent_train.heads import PredictedImage, head_of
from tangent_train.heads.pictures import evenly_spread
from tangent_train.inference import images
from tangent_train.inference.api import load_label_map, map_classes
from tangent_train.inference.engine import Predictor, UpLikelihood
from tangent_train.inference.mask_network import MaskNetwork, is_network
from tangent_train.inference.views import ViewSelector
from tangent_train.io.jobs import Inputs, Job, work_on
from tangent_train.manifest import Manifest, Shard
from tangent_train.results.predictions import PredictionFolder, encode_prediction


def predict(settings: PredictSettings) -> None:
    """Predict images and write the results.

    Raises:
        SettingError: A setting is invalid, or the output was written with other settings.
        DataError: The checkpoint cannot be read, or no images are found.
    """
    shard = Shard.parse(settings.shard)
    inputs = Inputs.find(settings.input, settings.every, settings.eye, settings.area)
    prediction = _Prediction(settings)
    folder, names = prediction.folder, inputs.names
    content = settings.model_dump(mode="json", exclude={*settings.not_content})
    content["write"] = list(folder.kinds)
    # Not its path: a copy continues a folder, a checkpoint that was trained further does not.
    with settings.checkpoint.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    same = {**content, "checkpoint": f"SHA-256 {digest}"}
    manifest = Manifest.open(settings.output, same, shard)
    missing = manifest.missing(shard.part(names))
    done = len(shard.part(names)) - len(missing)
    print_text(f"{counted(len(missing) + done, 'images')}, {done} done already.")
    prediction.shown = {names[k] for k in evenly_spread(settings.report, len(names))}
    errors = prediction.work("Predicting", prediction.predict, inputs, missing, manifest)
    manifest = Manifest.open(settings.output, same)  # with what other shards have finished
    left = manifest.missing(names)
    if left and not errors.keys() >= set(left):
        print_text(f"Shard {shard} is done: {len(names) - len(left)} of {len(names)} images.")
    elif len(errors) < len(names):
        finished = [name for name in names if name not in left]
        if second := prediction.one_scale:
            second.fit({name: manifest.finished[name][folder.head.summary] for name in finished})
            errors |= prediction.work("Scaling", prediction.scaled, inputs, finished, manifest)
        errors |= _write_videos(inputs, folder, manifest)
        entries = [{"name": n, **manifest.finished.get(n, errors.get(n, {}))} for n in names]
        folder.write_summary(content, entries)
        if shown := [finished[k] for k in evenly_spread(settings.report, len(finished))]:
            of_shown = {name: manifest.finished[name] for name in shown}
            folder.write_page(entries, list(prediction.pictures(inputs, of_shown)))
        folder.table(entries).print()
        if spoiled := [entry["name"] for entry in entries if entry.get("not_finite")]:
            count = counted(len(spoiled), "images")
            what = f"The network's output is NaN or infinite in parts of {count}"
            print_text(f"{what}: {listed(spoiled)}")
        print_text(f"Results are in {settings.output}.")
    if errors:
        total = len(missing) + done
        sys.exit(f"tangent-predict: {len(errors)} of {total} images could not be used, see above")


def _write_videos(
    inputs: Inputs, folder: PredictionFolder, manifest: Manifest
) -> dict[str, dict[str, Any]]:
    """Write the result videos of videos whose frames are all finished; return errors by name."""
    whole = {n: v for n, v in inputs.videos.items() if not manifest.missing(v.frames)}
    jobs = [Job(name, video.path) for name, video in whole.items()]

    def write(job: Job, _: Callable[[float], object]) -> None:
        video = whole[job.name]
        entries = [manifest.finished[name] for name in video.frames]
        folder.write_videos(job.name, video, inputs.every, entries)

    done = work_on("Making videos", jobs, len(jobs), write)
    return {job.name: {"error": job.error} for job in done if job.error}


class _Prediction:
    """Reads images, predicts them and writes the results.

    Attributes:
        folder: Output folder.
        one_scale: Second pass of the prediction, if any.
        shown: Names of the images in the report, whose confidence is kept for it.
    """

    def __init__(self, settings: PredictSettings) -> None:
        original = load_network(settings.checkpoint, settings.trust)
        original = loaded = original.prompted(settings.prompts, settings.threshold)
        if settings.label_map is not None:
            label_map = load_label_map(settings.label_map)
            mapped = map_classes(original, label_map, settings.unmapped)
            print_text(f"Label map {settings.label_map}: {mapped.description}.")
            loaded = mapped.loaded
        head: Any = head_of(loaded)
        kinds = head.file_kinds(settings.write)
        of_head = {
            name
            for name, needed in head.predict_settings.items()
            if needed in ("", *kinds) or (needed not in head.suffixes and getattr(settings, needed))
        }
        check_read(settings, _read(settings, loaded) | of_head)
        head = head_of(loaded, **{name: getattr(settings, name) for name in of_head})
        title = f"Predictions of {settings.checkpoint.name} ({type(loaded.module).__name__})"
        self.folder = PredictionFolder(settings.output, head, head.file_kinds(kinds), title)
        self.shown: Collection[str] = ()
        across = settings.align_across
        self.one_scale = across and OneScale(across, settings.output / "unscaled")
        self._confidences: dict[str, Any] = {}
        chosen = settings.levels, settings.base_level, settings.blend, settings.rotations
        views = ViewSelector(loaded, *chosen, settings.views, settings.fill)
        if settings.projection == "equirectangular":
            print_text(f"A panorama is predicted in {views.description(settings.area)}.")
        else:
            rows, columns = max(crops.image_size for crops in views.crops)
            print_text(f"Photos are predicted in crops of {columns} × {rows}.")
        if settings.upright == "auto":
            loaded.check_predicts(PIXEL_CLASSES, "Use upright=pose, or null.")
        self._settings, self._head = settings, head
        networks = [mask for mask in settings.mask or () if is_network(mask)]
        files = [mask for mask in settings.mask or () if mask not in networks]
        self._masks = mask_reader(files, settings.mask_classes)
        self._mask_networks = [MaskNetwork(file, settings) for file in networks]
        on_device = settings.device, settings.view_batch_size, settings.compile
        self._predictor = Predictor(loaded, head, views, *on_device)
        self._up_likelihood = UpLikelihood(original, self._predictor.device)
        if "depth" in loaded.inputs and settings.depth is None:
            expected = "a folder of depth images, which the network takes"
            raise SettingError("depth", found="null", expected=expected)
        of_file = settings.depth_scale, settings.depth_channel
        self._depth = images.DepthFolder(settings.depth, *of_file) if settings.depth else None

    def work(
        self, title: str, step: Any, inputs: Inputs, names: Collection[str], manifest: Manifest
    ) -> dict[str, dict[str, Any]]:
        """Take a step of the work on some images, and write the results; return errors by name."""
        errors, steps = dict[str, dict[str, Any]](), (step, self.read, self.write)
        with closing(work_on(title, inputs.jobs(names), len(names), *steps)) as jobs:
            for job in jobs:
                if job.error:
                    errors[job.name] = {"file": str(job.path), **job.place, "error": job.error}
                else:
                    manifest.finish(job.name, file=str(job.path), **job.value)
        return errors

    def read(self, job: Job) -> images.InputImage:
        """Read one image."""
        settings, image = self._settings, job.value or job.path
        depth = None if self._depth is None else partial(self._depth.read, job.name)
        if settings.projection == "perspective":
            return images.read_photo(image, settings.fov, depth)
        return images.read_panorama(image, settings.area, settings.upright, depth, settings.eye)

    def _upright(self, image: images.InputImage) -> images.InputImage:
        if self._settings.upright != "auto":
            return image
        return images.with_up(image, self._settings.max_tilt_deg, self._up_likelihood)

    def predict(self, job: Job, progress: Callable[[float], object]) -> tuple[Any, ...]:
        """Predict one image, without waiting for the device; see `PredictedImage.fetch`."""
        image, files = self._upright(job.value), self.folder.files(job)
        mosaic = self._predictor.predict(image, progress, averaged="probabilities" in files)
        self._head.write_mosaic(mosaic, image, files)
        if job.name in self.shown and getattr(mosaic, "has_probabilities", False):
            seen, step = True if image.valid is None else image.valid, -(-image.shape[0] // 1024)
            # At most 1024 rows, which saves memory.
            self._confidences[job.name] = (mosaic.confidences() * seen)[::step, ::step]

        def result() -> tuple[Any, Any]:
            return mosaic.pixels(), mosaic.facts

        return image, result if self._head.waits else result(), self._unmasked(image)

    def scaled(self, job: Job, progress: Callable[[float], object]) -> tuple[Any, ...]:
        """Return an image at its scale, as `predict` does."""
        one_scale: Any = self.one_scale
        return *one_scale.scaled(job, progress), self._unmasked(job.value)

    def _unmasked(self, image: images.InputImage) -> Any:
        """Return True where the networks of `mask` leave the pixels of an image."""
        return np.logical_and.reduce([network(image) for network in self._mask_networks])

    def write(self, job: Job) -> dict[str, Any]:
        """Write the results of one image; return its entry in the summary."""
        image, result, unmasked = job.value
        predicted = PredictedImage.fetch(image, *(result() if callable(result) else result))
        _, pixels, facts = predicted
        is_counted = np.array(True)
        if image.area is not None:
            is_counted = image.cut((self._masks(job.name, image.area) > 0) & unmasked)
            unknown = pixels.dtype.type(self._head.unknown)
            predicted = predicted._replace(pixels=np.where(is_counted, pixels, unknown))
        if self.one_scale and not self.one_scale.facts:
            unscaled = image.area.place(predicted.pixels)
            self._head.write_source(self.one_scale.file(job.name), unscaled)
        else:
            self._head.write(self.folder.files(job), predicted)
        entry: dict[str, Any] = {"rows": pixels.shape[0], "columns": pixels.shape[1]}
        if image.up is not None:
            entry["tilt_deg"] = round(math.degrees(math.acos(np.clip(image.up[2], -1, 1))), 2)
        entry |= job.place
        if self._settings.eye:
            entry["eye"] = self._settings.eye
        if share := facts.get("not_finite"):
            entry["not_finite"] = float(f"{share:.4g}")
        return entry | self._head.entry(predicted, is_counted)

    def pictures(self, inputs: Inputs, entries: Mapping[str, Any]) -> Iterator[Any]:
        """Yield compressed images for the report, if the predicted pixels were written.

        The least confident are first. Only images that this call has predicted have a confidence.
        """
        means = {name: found.mean() for name, found in self._confidences.items()}
        for job in sorted(inputs.jobs(entries), key=lambda job: means.get(job.name, 1)):
            file = self.folder.files(job).get(self._head.source)
            if file is not None:
                facts = entries[job.name]
                predicted = PredictedImage(self.read(job), self._head.read(file), facts)
                confidence = self._confidences.get(job.name)
                yield encode_prediction(self._head, job.name, predicted, confidence)


def _read(settings: PredictSettings, loaded: LoadedNetwork) -> set[str]:
    """Return the names of the settings that are read besides those of the head."""
    names = {"checkpoint", "input", "every", "output", "label_map", "projection"}
    names |= {"levels", "base_level", "blend", "write", "report", "shard", "prompts", "threshold"}
    names |= {"view_batch_size", "compile", "device", "trust"}
    panoramas = {"area", "eye", "fill", "views", "upright", "mask", "rotations"}
    if loaded.predicts == DISTANCE:
        panoramas |= {"align_across"}
    panoramas |= {"mask_classes"} if settings.mask is not None else set()
    names |= {"fov"} if settings.projection == "perspective" else panoramas
    names |= {"max_tilt_deg"} if settings.upright == "auto" else set()
    names |= {"unmapped"} if settings.label_map is not None else set()
    takes_depth = "depth" in loaded.inputs or loaded.things
    return names | ({"depth", "depth_scale", "depth_channel"} if takes_depth else set())


if __name__ == "__main__":
    main.predict()
