"""``tangent-predict``: labels of one's own images, as files."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from datamodules.image_files import find_images
from datamodules.progress import progress_bar
from tangent_train.cli import values
from tangent_train.errors import DataError, SettingError
from tangent_train.tasks.html import Table, ViewerImage, encode_image, write_report
from tangent_train.tasks.prediction.labellers import (
    DepthFolder,
    Labelled,
    Labeller,
    PanoramaLabeller,
    PhotoLabeller,
)
from tangent_train.tasks.prediction.outputs import OutputFolder, output_names
from tangent_train.tasks.prediction.panoramas import PanoramaPredictor
from tangent_train.tasks.prediction.photos import PhotoPredictor
from tangent_train.tasks.prediction.predictor import Level, Runner
from tangent_train.tasks.prediction.summary import write_summary
from tangent_train.tasks.trained import load_trained

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from omegaconf import DictConfig

    from tangent_train.rendering import Blend
    from tangent_train.tasks.html import EncodedImage
    from tangent_train.tasks.networks import TrainedNetwork

__all__ = ["predict"]

_CROP = "[west,east,south,north] in degrees, or null"


@dataclass(frozen=True)
class _Settings:
    """What the command line asks for, checked; see ``predict.yaml``."""

    checkpoint: Path
    input: str
    output: Path
    depth: Path | None
    depth_scale: float
    projection: str
    crop: list[float] | None
    fov: float | None
    level: Level
    base_level: int | None
    blend: Blend
    rotations: int
    probabilities: bool
    report: int
    overwrite: bool
    images_per_forward: int | None
    device: str

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> _Settings:
        """Check them.

        Raises:
            SettingError: One is missing or cannot work.
        """
        examples = {"checkpoint": "runs/…/best.ckpt", "input": "panoramas", "output": "labels"}
        for name, example in examples.items():
            if config[name] is None:
                raise SettingError(
                    name,
                    found="none",
                    expected="a file" if name == "checkpoint" else "a file or folder",
                    remedy=f"For example: tangent-predict {name}={example} …",
                )
        projection = values.choice(config, "projection", ("equirectangular", "perspective"))
        for name in ("crop", "rotations") if projection == "perspective" else ("fov",):
            if config[name] not in (None, 1):
                raise SettingError(
                    name, found=config[name], expected=f"null with projection={projection}"
                )
        depth = values.path(config, "depth")
        if depth is not None and not depth.is_dir():
            raise SettingError("depth", found=str(depth), expected="a folder of depth images")
        image_level = config["level"] == "image"
        return cls(
            checkpoint=Path(str(config["checkpoint"])).expanduser(),
            input=str(config["input"]),
            output=Path(str(config["output"])).expanduser(),
            depth=depth,
            depth_scale=values.number(config, "depth_scale", 0, math.inf),
            projection=projection,
            crop=values.numbers(config, "crop", _CROP),
            fov=None if config["fov"] is None else values.number(config, "fov", 0, 180),
            level="image" if image_level else values.optional_whole(config, "level", 0),
            base_level=values.optional_whole(config, "base_level", 0),
            blend=values.choice(config, "blend", ("feather", "nearest")),
            rotations=values.whole(config, "rotations", 1),
            probabilities=values.flag(config, "probabilities"),
            report=values.whole(config, "report", 0),
            overwrite=values.flag(config, "overwrite"),
            images_per_forward=values.optional_whole(config, "images_per_forward", 1),
            device=str(config["device"]),
        )


def predict(config: DictConfig) -> None:
    """Label images and write what was found.

    Args:
        config: The composed ``predict.yaml``.

    Raises:
        SettingError: A setting is missing or cannot work.
        DataError: The checkpoint cannot be read, or there are no images.
    """
    settings = _Settings.of(OmegaConf.to_container(config, resolve=True))  # type: ignore[arg-type]
    paths = _without_results(find_images(settings.input), settings)
    names = output_names(paths)
    trained = load_trained(settings.checkpoint)
    output = OutputFolder(settings.output, trained.class_names, settings.probabilities)
    labeller = _labeller(settings, trained)
    output.check(names, overwrite=settings.overwrite)
    console = Console(soft_wrap=True, highlight=False)
    console.print(_what_happens(settings, trained, len(paths)))
    entries: list[dict[str, Any]] = []
    shown: list[EncodedImage] = []
    try:
        for entry, found in _label_all(paths, names, labeller, output):
            entries.append(entry)
            if found is not None and len(shown) < settings.report:
                shown.append(_shown(entry, found, len(trained.class_names)))
    finally:
        if entries:  # those done are kept when it is interrupted
            output.write_classes()
            write_summary(output.path, _summary(settings, trained, entries), trained.class_names)
    done = [entry for entry in entries if "error" not in entry]
    if shown:
        _write_report(output, done, shown, _what_happens(settings, trained, len(done)))
    if done:
        console.print(_terminal_table(done, trained.class_names))
        console.print(f"Results are in {output.path}.", markup=False)
    if len(done) < len(entries):
        failed = f"{len(entries) - len(done)} of {len(entries)} images"
        sys.exit(f"tangent-predict: {failed} could not be used, see above")


def _without_results(paths: Sequence[Path], settings: _Settings) -> list[Path]:
    """The images that are not results of this command in its output folder."""
    results = [(settings.output / kind).resolve() for kind in ("labels", "color", "overlay")]
    kept = [p for p in paths if not any(p.resolve().is_relative_to(r) for r in results)]
    if not kept:
        raise SettingError("input", found=f"only results in {settings.output}", expected="images")
    return kept


def _labeller(settings: _Settings, trained: TrainedNetwork) -> Labeller:
    runner = Runner(trained, _device(settings.device), settings.images_per_forward)
    depth = _depth(settings, trained)
    seen = (trained, runner, settings.level, settings.base_level, settings.blend)
    names = trained.class_names
    if settings.projection == "perspective":
        return PhotoLabeller(PhotoPredictor(*seen), names, settings.fov, depth)
    return PanoramaLabeller(
        PanoramaPredictor(*seen, settings.rotations), names, settings.crop, depth
    )


def _depth(settings: _Settings, trained: TrainedNetwork) -> DepthFolder | None:
    wanted, given = "depth" in trained.inputs, settings.depth is not None
    if wanted != given:
        raise SettingError(
            "depth",
            found=str(settings.depth) if given else "none",
            expected="a folder of depth images, for a network that takes RGB and depth"
            if wanted
            else "null, for a network that takes RGB only",
            remedy="Give depth=<folder>, or use a network trained with data.inputs=[rgb]."
            if wanted
            else "",
        )
    return DepthFolder(settings.depth, settings.depth_scale) if settings.depth else None


def _device(name: str) -> str:
    import torch

    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() else "cpu"


def _what_happens(settings: _Settings, trained: TrainedNetwork, count: int) -> str:
    level = trained.level if settings.level is None else settings.level
    level = "of each image" if level == "image" else level
    noun = "panorama" if settings.projection == "equirectangular" else "photo"
    return (
        f"{count} {noun}{'s' if count != 1 else ''}, {len(trained.class_names) - 1} classes, "
        f"level {level} (the network's is {trained.level}), blend {settings.blend}, "
        f"{'RGB and depth' if 'depth' in trained.inputs else 'RGB'}"
    )


def _label_all(
    paths: Sequence[Path], names: Sequence[str], labeller: Labeller, output: OutputFolder
) -> Iterator[tuple[dict[str, Any], Labelled | None]]:
    """What is known of each image, as soon as its files are written; None for broken ones."""
    begun = time.monotonic()
    with progress_bar() as bar:
        task = bar.add_task("Labelling images", total=len(paths), rate="")
        for number, (path, name) in enumerate(zip(paths, names, strict=True), start=1):
            entry: dict[str, Any] = {"file": str(path), "name": name}
            start = time.monotonic()
            without_suffix = name.removesuffix(path.suffix)
            try:
                found = labeller.label(
                    path,
                    without_suffix,
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
                # Without the scores: one image's are in memory, not two.
                found = replace(found, mosaic=None)
                yield entry | {"seconds": round(time.monotonic() - start, 3)}, found
                del found
            rate = f"{number / (time.monotonic() - begun):.2f} images/s"
            bar.update(task, completed=number, rate=rate)


def _shown(entry: dict[str, Any], found: Labelled, class_count: int) -> EncodedImage:
    """An image for the report, a few hundred kilobytes to some megabytes."""
    rgb, labels = found.rgb, found.labels
    if found.area is not None:
        rgb, labels = found.area.place(rgb), found.area.place(labels)
    note = f"{entry['rows']}×{entry['columns']}, level {entry['level']}"
    image = ViewerImage(entry["name"], rgb, labels, None, sphere=found.area is not None, note=note)
    return encode_image(image, class_count)


def _summary(
    settings: _Settings, trained: TrainedNetwork, entries: list[dict[str, Any]]
) -> dict[str, Any]:
    how = {
        name: getattr(settings, name) for name in ("projection", "blend", "rotations", "base_level")
    }
    done = [entry for entry in entries if "error" not in entry]
    return {
        "checkpoint": str(settings.checkpoint),
        "level": trained.level if settings.level is None else settings.level,
        **how,
        "classes": _mean_shares(done, trained.class_names),
        "images": entries,
    }


def _mean_shares(done: Sequence[dict[str, Any]], class_names: Sequence[str]) -> dict[str, float]:
    count = max(1, len(done))
    return {n: sum(entry["classes"][n] for entry in done) / count for n in class_names[1:]}


def _terminal_table(done: Sequence[dict[str, Any]], class_names: Sequence[str]) -> RichTable:
    shares = sorted(_mean_shares(done, class_names).items(), key=lambda item: -item[1])
    table = RichTable(title="Mean over the images")
    table.add_column("class")
    table.add_column("solid angle %", justify="right")
    for name, share in shares:
        table.add_row(escape(name), f"{100 * share:.1f}")
    return table


def _write_report(
    output: OutputFolder,
    done: Sequence[dict[str, Any]],
    shown: Sequence[EncodedImage],
    how: str,
) -> None:
    names = output.class_names[1:]
    rows = [
        [entry["name"], *(f"{100 * entry['classes'][name]:.1f}" for name in names)]
        for entry in done
    ]
    mean = _mean_shares(done, output.class_names)
    rows.append(["mean", *(f"{100 * mean[name]:.1f}" for name in names)])
    tables = [
        Table("Solid angle of the classes, %", ["image", *names], rows, "Of what is labelled.")
    ]
    if all("seam_ratio" in entry for entry in done):
        header = ["image", "across borders %", "inside %", "ratio"]
        seams = [
            [entry["name"]]
            + [f"{100 * entry[name]:.2f}" for name in ("seam_border", "seam_inside")]
            + [f"{entry['seam_ratio']:.2f}"]
            for entry in done
        ]
        note = "How often neighbouring pixels differ; where borders do not show, the ratio is 1."
        tables.append(Table("Seams between tangent images", header, seams, note))
    notes = [how]
    if len(shown) < len(done):
        notes.append(f"The first {len(shown)} of {len(done)} images are shown (report=…).")
    write_report(
        output.path / "report.html",
        "Predictions",
        tables=tables,
        images=shown,
        class_names=output.class_names,
        notes=notes,
    )
