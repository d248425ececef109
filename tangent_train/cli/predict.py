"""``tangent-predict``: labels of one's own images, as files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table as RichTable

from datamodules.image_files import find_images
from datamodules.progress import progress_bar
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
from tangent_train.tasks.prediction.predictor import Runner
from tangent_train.tasks.prediction.summary import write_summary
from tangent_train.tasks.trained import load_trained

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from omegaconf import DictConfig

    from tangent_train.tasks.html import EncodedImage
    from tangent_train.tasks.networks import TrainedNetwork

__all__ = ["predict"]

_MOST_FOV_DEG = 180


def _whole_from_0(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


_ALLOWED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "projection": (
        lambda value: value in ("equirectangular", "perspective"),
        "equirectangular or perspective",
    ),
    "blend": (lambda value: value in ("feather", "nearest"), "feather or nearest"),
    "level": (
        lambda value: value in (None, "image") or _whole_from_0(value),
        "a whole number from 0, image, or null for the network's",
    ),
    "base_level": (
        lambda value: value is None or _whole_from_0(value),
        "a whole number from 0, or null for the network's",
    ),
    "fov": (
        lambda value: (
            value is None or (isinstance(value, int | float) and 0 < value < _MOST_FOV_DEG)
        ),
        "degrees between 0 and 180, or null",
    ),
    "report": (_whole_from_0, "a number of images, 0 for no report"),
    "depth_scale": (
        lambda value: isinstance(value, int | float) and value > 0,
        "units per metre, more than 0",
    ),
}
"""What settings may be, and how to say so."""


def predict(config: DictConfig) -> None:
    """Label images and write what was found.

    Args:
        config: The composed ``predict.yaml``.

    Raises:
        SettingError: A setting is missing or cannot work.
        DataError: The checkpoint cannot be read, or there are no images.
    """
    _check(config)
    paths = find_images(config.input)
    names = output_names(paths)
    trained = load_trained(Path(config.checkpoint).expanduser())
    output = OutputFolder(
        Path(config.output).expanduser(), trained.class_names, config.probabilities
    )
    output.check(names, overwrite=config.overwrite)
    labeller = _labeller(config, trained)
    console = Console(soft_wrap=True, highlight=False)
    console.print(_what_happens(config, trained, len(paths)))
    entries: list[dict[str, Any]] = []
    shown: list[EncodedImage] = []
    try:
        for entry, found in _label_all(paths, names, labeller, output):
            entries.append(entry)
            if found is not None and len(shown) < config.report:
                shown.append(_shown(entry, found, len(trained.class_names)))
    finally:
        if entries:  # those done are kept when it is interrupted
            output.write_classes()
            write_summary(output.path, _summary(config, trained, entries), trained.class_names)
    done = [entry for entry in entries if "error" not in entry]
    if shown:
        _write_report(output, done, shown, _what_happens(config, trained, len(done)))
    if done:
        console.print(_terminal_table(done, trained.class_names))
        console.print(f"Results are in {output.path}.", markup=False)
    if len(done) < len(entries):
        failed = f"{len(entries) - len(done)} of {len(entries)} images"
        sys.exit(f"tangent-predict: {failed} could not be used, see above")


def _check(config: DictConfig) -> None:
    for name, example in (
        ("checkpoint", "runs/…/checkpoints/best.ckpt"),
        ("input", "panoramas"),
        ("output", "labels"),
    ):
        if config[name] is None:
            raise SettingError(
                name,
                found="none",
                expected="a file" if name == "checkpoint" else "a file or folder",
                remedy=f"For example: tangent-predict {name}={example} …",
            )
    for name, (allowed, expected) in _ALLOWED.items():
        if not allowed(config[name]):
            raise SettingError(name, found=repr(config[name]), expected=expected)
    panoramas = config.projection == "equirectangular"
    unused = ("fov",) if panoramas else ("crop", "rotations")
    for name in unused:
        if config[name] not in (None, 1):
            raise SettingError(
                name, found=config[name], expected=f"null with projection={config.projection}"
            )
    if config.depth is not None and not Path(config.depth).expanduser().is_dir():
        raise SettingError("depth", found=str(config.depth), expected="a folder of depth images")


def _labeller(config: DictConfig, trained: TrainedNetwork) -> Labeller:
    runner = Runner(trained, _device(config.device), config.images_per_forward)
    depth = _depth(config, trained)
    seen = (trained, runner, config.level, config.base_level, config.blend)
    names = trained.class_names
    if config.projection == "perspective":
        return PhotoLabeller(PhotoPredictor(*seen), names, config.fov, depth)
    crop = None if config.crop is None else list(config.crop)
    return PanoramaLabeller(PanoramaPredictor(*seen, config.rotations), names, crop, depth)


def _depth(config: DictConfig, trained: TrainedNetwork) -> DepthFolder | None:
    wanted, given = "depth" in trained.inputs, config.depth is not None
    if wanted != given:
        raise SettingError(
            "depth",
            found=str(config.depth) if given else "none",
            expected="a folder of depth images, for a network that takes RGB and depth"
            if wanted
            else "null, for a network that takes RGB only",
            remedy="Give depth=<folder>, or use a network trained with data.inputs=[rgb]."
            if wanted
            else "",
        )
    return DepthFolder(Path(config.depth).expanduser(), config.depth_scale) if given else None


def _device(name: str) -> str:
    import torch

    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() else "cpu"


def _what_happens(config: DictConfig, trained: TrainedNetwork, count: int) -> str:
    level = trained.level if config.level is None else config.level
    level = "of each image" if level == "image" else level
    noun = "panorama" if config.projection == "equirectangular" else "photo"
    return (
        f"{count} {noun}{'s' if count != 1 else ''}, {len(trained.class_names) - 1} classes, "
        f"level {level} (the network's is {trained.level}), blend {config.blend}, "
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
            try:
                found = labeller.label(
                    path, lambda share: bar.advance(task, share), averaged=output.probabilities
                )
            except DataError as error:
                bar.console.print(str(error), style="red", markup=False, soft_wrap=True)
                yield entry | {"error": str(error)}, None
            else:
                output.write(name, found)
                rows, columns = found.labels.shape
                entry |= {"rows": rows, "columns": columns} | found.figures
                yield entry | {"seconds": round(time.monotonic() - start, 3)}, found
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
    config: DictConfig, trained: TrainedNetwork, entries: list[dict[str, Any]]
) -> dict[str, Any]:
    settings = {name: config[name] for name in ("projection", "blend", "rotations", "base_level")}
    done = [entry for entry in entries if "error" not in entry]
    return {
        "checkpoint": str(config.checkpoint),
        "level": trained.level if config.level is None else config.level,
        **settings,
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
        table.add_row(name, f"{100 * share:.1f}")
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
