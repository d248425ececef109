"""``tangent-predict``: labels of one's own images, as files."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rich.console import Console

from datamodules.core.progress import progress_bar
from datamodules.images.image_files import find_images
from tangent_train.checkpoints.trained import load_trained
from tangent_train.cli.prediction.report import (
    Entry,
    shares_table,
    shown_image,
    summary,
    what_happens,
    write_prediction_report,
)
from tangent_train.cli.prediction.settings import PredictSettings
from tangent_train.errors import DataError, SettingError
from tangent_train.inference.labellers import (
    DepthFolder,
    Labelled,
    Labeller,
    PanoramaLabeller,
    PhotoLabeller,
)
from tangent_train.inference.outputs import OutputFolder, output_names
from tangent_train.inference.panoramas import PanoramaPredictor
from tangent_train.inference.photos import PhotoPredictor
from tangent_train.inference.predictor import Runner
from tangent_train.inference.summary import write_summary
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.results.html import EncodedImage

__all__ = ["predict"]

_KEPT = ("checkpoint", "projection", "level", "base_level", "blend", "rotations")
"""What results that are gone on with have to agree in."""

_LATER = ("upright", "max_tilt_deg")
"""Likewise, of results that say it; older ones are of panoramas taken as they were."""


def predict(config: Mapping[str, Any]) -> None:
    """Label images and write what was found.

    Args:
        config: The composed ``predict.yaml``.

    Raises:
        SettingError: A setting is missing or cannot work.
        DataError: The checkpoint cannot be read, or there are no images.
    """
    settings = PredictSettings.of(config)
    paths = _without_results(find_images(settings.input), settings)
    images = dict(zip(output_names(paths), paths, strict=True))
    if len(images) < len(paths):
        raise SettingError("input", found="an image twice", expected="every image once")
    trained = load_trained(settings.checkpoint, settings.trust)
    output = OutputFolder(settings.output, trained.class_names, settings.probabilities)
    labeller = _labeller(settings, trained)
    earlier = _earlier(settings, trained, output) if settings.resume else {}
    output.check(images, overwrite=settings.overwrite or bool(earlier))
    missing = {name: path for name, path in images.items() if name not in earlier}
    console = Console(soft_wrap=True, highlight=False)
    how = what_happens(settings, trained, len(images))
    kept = f"; {len(images) - len(missing)} of them are there already" if earlier else ""
    console.print(how + kept)
    entries = [entry for name, entry in earlier.items() if name in images]
    shown: list[EncodedImage] = []
    try:
        for entry, found in _label_all(missing, labeller, output):
            entries.append(entry)
            if found is not None and len(shown) < settings.report:
                shown.append(shown_image(entry, found, len(trained.class_names)))
    except KeyboardInterrupt:
        console.print(
            f"Interrupted: {len(entries)} of {len(images)} images are done. resume=true goes on.",
            markup=False,
        )
        raise
    finally:
        done = [entry for entry in entries if "error" not in entry]
        if done:
            output.write_classes()
            write_summary(output.path, summary(settings, trained, entries), trained.class_names)
    if shown:
        write_prediction_report(output, entries, shown, how)
    if done:
        console.print(shares_table(done, trained.class_names))
        console.print(f"Results are in {output.path}.", markup=False)
    if len(done) < len(entries):
        failed = f"{len(entries) - len(done)} of {len(entries)} images"
        sys.exit(f"tangent-predict: {failed} could not be used, see above")


def _without_results(paths: Sequence[Path], settings: PredictSettings) -> list[Path]:
    """The images that are not results of this command in its output folder."""
    results = [(settings.output / kind).resolve() for kind in ("labels", "color", "overlay")]
    kept = [p for p in paths if not any(p.resolve().is_relative_to(r) for r in results)]
    if not kept:
        raise SettingError("input", found=f"only results in {settings.output}", expected="images")
    return kept


def _earlier(
    settings: PredictSettings, trained: TrainedNetwork, output: OutputFolder
) -> dict[str, Entry]:
    """What is known of the images whose results are there, by name.

    Raises:
        SettingError: They were made in another way.
    """
    try:
        content = parse_json((output.path / "summary.json").read_bytes())
        entries = {entry["name"]: entry for entry in content["images"] if "error" not in entry}
        before = {name: content[name] for name in _KEPT}
        before |= {name: content[name] for name in _LATER if name in content}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    now = summary(settings, trained, [])
    for name, value in before.items():
        if value != now[name]:
            raise SettingError(
                name,
                found=now[name],
                expected=f"{value}, as for the results in {output.path}",
                remedy="Give another folder, or overwrite=true.",
            )
    return {
        name: e
        for name, e in entries.items()
        if all(f.is_file() for f in output.files(name).values())
    }


def _labeller(settings: PredictSettings, trained: TrainedNetwork) -> Labeller:
    runner = Runner(trained, _device(settings.device), settings.images_per_forward)
    depth = _depth(settings, trained)
    seen = (trained, runner, settings.level, settings.base_level, settings.blend)
    names = trained.class_names
    if settings.projection == "perspective":
        return PhotoLabeller(PhotoPredictor(*seen), names, settings.fov, depth)
    upright = settings.upright is not None
    predictor = PanoramaPredictor(*seen, settings.rotations, upright=upright)
    tilts = settings.upright, settings.max_tilt_deg
    return PanoramaLabeller(predictor, names, settings.crop, depth, *tilts)


def _depth(settings: PredictSettings, trained: TrainedNetwork) -> DepthFolder | None:
    if "depth" in trained.inputs:
        if settings.depth is not None:
            return DepthFolder(settings.depth, settings.depth_scale)
        raise SettingError(
            "depth",
            found="none",
            expected="a folder of depth images, for a network that takes RGB and depth",
            remedy="Give depth=<folder>, or use a network trained with data.inputs=[rgb].",
        )
    if settings.depth is not None:
        raise SettingError(
            "depth",
            found=str(settings.depth),
            expected="none, for a network that takes RGB only",
            remedy="Leave it out.",
        )
    return None


def _device(name: str) -> str:
    import torch

    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() else "cpu"


def _label_all(
    images: Mapping[str, Path], labeller: Labeller, output: OutputFolder
) -> Iterator[tuple[Entry, Labelled | None]]:
    """What is known of each image, as soon as its files are written; None for broken ones."""
    begun = time.monotonic()
    with progress_bar() as bar:
        task = bar.add_task("Labelling images", total=len(images), rate="")
        for number, (name, path) in enumerate(images.items(), start=1):
            entry: Entry = {"file": str(path), "name": name}
            start = time.monotonic()
            try:
                found = labeller.label(
                    path,
                    name.removesuffix(path.suffix),
                    lambda share: bar.advance(task, share),
                    averaged=output.probabilities,
                )
            except (DataError, SettingError, MemoryError) as error:
                message = f"{path}: {error}" if isinstance(error, MemoryError) else str(error)
                bar.console.print(message, style="red", markup=False, soft_wrap=True)
                yield entry | {"error": message}, None
            else:
                output.write(name, found)
                rows, columns = found.labels.shape
                entry |= {"rows": rows, "columns": columns} | found.figures
                entry["seconds"] = round(time.monotonic() - start, 3)
                # Without the scores: one image's are in memory, not two.
                found = replace(found, mosaic=None)
                yield entry, found
                del found
            rate = f"{number / (time.monotonic() - begun):.2f} images/s"
            bar.update(task, completed=number, rate=rate)
