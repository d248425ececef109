"""Score the files of any program against the test images of a data set, without a network."""

from __future__ import annotations

import csv
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import PANOPTIC, PIXEL_CLASSES, LabelMap, read_label_map
from tangent_train.callbacks.pictures import Pictures
from tangent_train.cli.run import Run, build_data, build_head
from tangent_train.config.settings import EvaluateSettings, FilesSettings, refuse_typed
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, counted, listed, width_height
from tangent_train.geometry.sphere import check_area
from tangent_train.heads.pictures import evenly_spread
from tangent_train.io.gpano import read_area
from tangent_train.io.image_files import composed, walk_files
from tangent_train.io.pixel_files import read_depth_m, read_image_size
from tangent_train.metrics.panoptic import LABEL
from tangent_train.progress import show_progress
from tangent_train.rendering.resampling import resize
from tangent_train.results.tables import Table, percent, score_text
from tangent_train.threads import in_threads

_OF_NETWORKS = (
    *("checkpoint", "trust", "label_map", "unmapped", "level", "trainer", "logger"),
    *("representation(?!.erp_height)", "data.inputs", "data.normalization"),
    *("data.test_rotation", "data.upright", "consistency", "input"),
)
_ARRAYS = (".npy", ".npz")
_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".exr", *_ARRAYS)
_NO_CLASS = (255, 65535)
_NAMED = 10
_COMPARED, _NOTED, _AS_THEY_ARE = 8, 0.05, "as they are"
_MISTAKES: dict[str, Callable[[Tensor], Tensor]] = {
    "mirrored left to right": lambda pixels: pixels.flip(1),
    "upside down": lambda pixels: pixels.flip(0),
    "shifted by half the width": lambda pixels: pixels.roll(pixels.shape[1] // 2, 1),
}
"""Usual mistakes in the orientation of predictions. They are named if the score of some images is
better without by a margin."""


def score_files(settings: EvaluateSettings, folder: Path) -> None:
    """Evaluate predictions in files on the test images of the data, and write the results.

    Args:
        settings: Settings of the command.
        folder: Output folder.

    Raises:
        SettingError: A setting does not suit the data, or is that of a network.
        DataError: No prediction can be used.
    """
    predictions: Any = settings.predictions
    refuse_typed(_OF_NETWORKS, "nothing: predictions= is scored without a network")
    scored = ScoredFiles(settings)
    data, head = scored.data, scored.head
    metric = head.build_metric()
    pictures = Pictures(folder / "panels", settings.panels)
    task = SimpleNamespace(network=None, head=head, representation=data.representation)
    variants = Variants(scored)

    def score(place: int, labels: Tensor, prediction: Tensor) -> None:
        truth = head.truth(labels)
        comparable = head.comparable(prediction, truth)
        metric.update(comparable, truth)
        variants.update(place, prediction, truth)
        index = scored.indices[place]
        pictures.draw(task, data.dataset("test"), index, None, labels, comparable)

    scored.for_each(score, "Scoring")
    task.result, task.evaluated = metric.compute(), len(scored.done)
    if warning := variants.warning():
        print_text(f"Warning: {warning}", error=True)
    settings = settings.model_copy(update={"representation": {"erp_height": data.erp_height}})
    run = Run(folder, settings, data, task, facts=scored.facts)
    run.write_settings()
    run.report(predictions, scored.done, [pictures])


def check_files(settings: FilesSettings) -> bool:
    """Print how predictions in files fit the test images; return True if nothing is wrong.

    Args:
        settings: Settings of the command.

    Raises:
        DataError: No prediction can be used.
    """
    scored = ScoredFiles(settings)
    data, variants = scored.data, Variants(scored)
    counts = np.zeros((2, len(data.label_names)), np.int64)

    def count(place: int, labels: Tensor, prediction: Tensor) -> None:
        variants.update(place, prediction, scored.head.truth(labels))
        for row, pixels in enumerate((prediction, labels)):
            shown = data.counted_labels(pixels).flatten()
            counts[row] += np.bincount(shown.numpy(), minlength=counts.shape[1])

    scored.for_each(count, "Checking")
    missing, unusable, _ = problems = scored.problems
    rows = [("usable predictions", str(len(scored.done)))]
    rows += [(noun + what, str(len(names))) for noun, what, names in problems]
    Table(f"Files for {counted(len(scored.items), data.noun)}", ("", "number"), rows).print()
    shares = ([percent(share) for share in of / of.sum()] for of in counts)
    classes = [*zip(data.label_names, *shares, strict=True)]
    Table("Pixels, %", ("label", "predictions", "ground truth"), classes).print()
    variants.table().print()
    if warning := variants.warning():
        print_text(f"Warning: {warning}")
    return not (missing[2] or unusable[2] or warning)


class Variants:
    """Scores of predictions as they are, and without each of the usual mistakes.

    Args:
        scored: Files, of which a few are compared.
    """

    def __init__(self, scored: ScoredFiles) -> None:
        head, data = scored.head, scored.data
        numberings = {} if data.labels != PIXEL_CLASSES else _numberings(data.num_classes)
        self._head, self._changes = head, {_AS_THEY_ARE: torch.clone} | _MISTAKES | numberings
        self._metrics = {name: head.build_metric() for name in self._changes}
        self._compared = set(evenly_spread(_COMPARED, len(scored.indices)))
        self.images = counted(len(self._compared), data.noun)

    def update(self, place: int, prediction: Tensor, truth: Tensor) -> None:
        """Score the prediction at a place, if it is one of those that are compared."""
        for name, change in self._changes.items() if place in self._compared else ():
            self._metrics[name].update(self._head.comparable(change(prediction), truth), truth)

    @cached_property
    def scores(self) -> dict[str, float]:
        """Main score of each variant, after all updates."""
        of_metrics = {name: metric.compute() for name, metric in self._metrics.items()}
        main = self._head.main_score
        return {name: self._head.scores(of).means[main] for name, of in of_metrics.items()}

    def table(self) -> Table:
        """Return the table of the scores."""
        column = self._head.columns[self._head.main_score]
        rows = [(name, score_text(score, column.unit)) for name, score in self.scores.items()]
        return Table(
            f"With usual mistakes undone, on {self.images}", ("predictions", column.title), rows
        )

    def warning(self) -> str:
        """Return a warning if a variant is better by a margin; else ""."""
        column, scores = self._head.columns[self._head.main_score], self.scores
        best = min if column.better == "lower" else max
        name = best(scores, key=lambda name: scores[name])
        if not abs(scores[name] - scores[_AS_THEY_ARE]) > _NOTED:
            return ""
        found, usual = (score_text(scores[n], column.unit) for n in (name, _AS_THEY_ARE))
        score = f"{column.text} {found} instead of {usual}"
        return f"{name}, predictions score {score} on {self.images}."


def _numberings(num_classes: int) -> dict[str, Callable[[Tensor], Tensor]]:
    """Return labels as if their numbers began with 0, or with 1 instead of 0."""
    return {
        "numbered from 0 (values=from_0)": lambda labels: (labels + 1) * (labels < num_classes),
        "numbered from 1 (values=from_1)": lambda labels: labels - (labels > 0).to(labels.dtype),
    }


def _data(settings: FilesSettings, rows: int | None) -> Any:
    """Build the data module; without a number of rows its panoramas have those of the first."""
    views = {"_target_": "tangent_train.rendering.EquirectRepresentation", "level": 0}
    section = views | {"erp_height": rows or 2}
    changes = {"representation": section, "data": {**settings.data, "inputs": ["rgb"]}}
    data = build_data(settings.model_copy(update=changes))
    if not isinstance(data, PanoramaDataModule):
        raise SettingError("data", found=type(data).__name__, expected="panoramas, not photos")
    images: Any = ()
    with data.problems.noted():  # the data module with the size names them
        images = () if rows else data.files()[data.test_split]
    for files in images:
        with data.problems.noted(files.name):
            area = read_area(files.rgb, read_image_size(files.rgb), check_area(data.area))
            return _data(settings, area.full_shape[0])
    return data


class ScoredFiles:
    """Files with predictions, matched with the test images of a data set.

    Attributes:
        data: Data module.
        head: Head that scores the predictions.
        items: Files of all test images.
        indices: Places of the images that have a prediction.
        done: Places of the images that were scored.
    """

    def __init__(self, settings: FilesSettings) -> None:
        self.data = data = _data(settings, (settings.representation or {}).get("erp_height"))
        self.head = build_head(settings, data, "metric_distance" if data.has_distances else None)
        self._settings = settings
        self.items = data.splits()["test"]
        self._paths, self._extra = self._matched()
        self.indices = [k for k, files in enumerate(self.items) if files.name in self._paths]
        self.done: list[int] = []
        self._problems: list[DataError] = []
        self._resampled: set[str] = set()
        self._map = None if data.has_distances else self._label_map()

    @property
    def facts(self) -> dict[str, str]:
        """Facts of the protocol: images without a usable prediction, and other sizes."""
        total, done = len(self.items), len(self.done)
        facts = {} if done == total else {"images": f"{done} of {total}"}
        if self._resampled:
            sizes = ", ".join(sorted(self._resampled))
            facts["resampled"] = f"{self._settings.resample}, from {sizes}"
        return facts

    def for_each(self, use: Callable[[int, Tensor, Tensor], None], description: str) -> None:
        """Read all predictions; print what cannot be used.

        Args:
            use: Function of the place in `indices`, the labels and the prediction.
            description: Description of the work.

        Raises:
            DataError: No prediction can be used.
        """

        def used() -> Iterator[None]:
            for place, (index, found) in enumerate(in_threads(self.read, self.indices)):
                if found is not None:
                    use(place, *map(torch.from_numpy, found))
                    self.done.append(index)
                yield

        show_progress(used(), description, self.data.noun, len(self.indices))
        for noun, what, names in self.problems:
            if names:
                lines = "".join(f"\n  {name}" for name in names[:_NAMED])
                more = f"\n  … {len(names) - _NAMED} more" * (len(names) > _NAMED)
                print_text(f"{counted(len(names), noun)}{what}:{lines}{more}", error=True)
        if not self.done:
            raise DataError(
                self._settings.predictions or "",
                found=f"no usable prediction for {counted(len(self.items), self.data.noun)}",
                expected=f"files named as the images, such as {self.items[0].name}.png",
                remedy="Or give files=, a CSV file with the columns image and prediction.",
            )

    @property
    def problems(self) -> list[tuple[str, str, list[str]]]:
        """Names of missing, unusable and extra files, after their kind and where it differs."""
        missing = [files.name for files in self.items if files.name not in self._paths]
        return [
            ("images", " without a prediction", missing),
            ("unusable predictions", "", [str(error) for error in self._problems]),
            ("files", " of no test image", [str(path) for path in self._extra]),
        ]

    def _folder(self) -> Path:
        """Return the folder of the files: of an output folder of this project, a part of it."""
        given: Any = self._settings.predictions
        kind = given / self.head.source
        return kind if kind.is_dir() else given

    def _matched(self) -> tuple[dict[str, Path], list[Path]]:
        """Return the file of each image, by its name or the last part of it; and the others."""
        folder, table = self._folder(), self._settings.files
        files = [path for path in walk_files(folder) if path.suffix.lower() in _SUFFIXES]
        named = [(path.relative_to(folder).as_posix(), path) for path in files]
        if table is not None:
            with table.open(newline="", encoding="utf-8-sig") as lines:
                rows = list(csv.DictReader(lines))
            if not rows or not {"image", "prediction"} <= rows[0].keys():
                expected = "a CSV file with the columns image and prediction"
                found = ", ".join(rows[0]) if rows else "no row"
                raise DataError(table, found=found, expected=expected)
            named = [(row["image"], folder / row["prediction"]) for row in rows]
        paths: dict[str, set[Path]] = defaultdict(set)
        for name, path in named:
            stem = composed(name.removesuffix(PurePosixPath(name).suffix))
            for key in (composed(name), stem, stem.rpartition("/")[2]):
                paths[key].add(path)
        stems = Counter(item.rgb.stem for item in self.items)
        matched = {}
        for item in self.items:
            keys = [item.name, *[composed(item.rgb.stem)] * (stems[item.rgb.stem] == 1)]
            matches = [paths[key] for key in keys if len(paths[key]) == 1]
            if matches:
                (matched[item.name],) = matches[0]
        return matched, sorted({*files} - {*matched.values()})

    def _label_map(self) -> LabelMap:
        """Return the labels of the values in the files."""
        data, values = self.data, self._settings.values
        own: Any = self._settings.predictions
        if values is None and (own / "classes.json").is_file():
            values = own / "classes.json"
        classes = data.class_names[1:]
        if values in (None, "from_1", "from_0"):
            start = 0 if values == "from_0" else 1
            unknown = [*_NO_CLASS, *range(start)]
            return LabelMap.of({name: k for k, name in enumerate(classes, start)}, unknown)
        if values == "ids":
            label_map: LabelMap = data.label_map
            return label_map
        found = read_label_map(Path(values))
        if foreign := set(found.names) - set(classes):
            expected = f"classes of {listed(classes)}"
            remedy = (
                "Give a JSON file with the values of each of these as values=; or predict with "
                "label_map=, if tangent-predict wrote the files."
            )
            raise DataError(values, found=listed(sorted(foreign)), expected=expected, remedy=remedy)
        return replace(found.regrouped(classes), refuses_others=found.refuses_others)

    def read(self, index: int) -> tuple[int, tuple[NDArray[Any], NDArray[Any]] | None]:
        """Return the place of an image, its labels and its prediction; None if it is unusable."""
        source = self.data.dataset("test")
        try:
            prediction = self._placed(self._paths[self.items[index].name])
            is_whole = self.data.canvas.is_whole
            truth = source.labels(index) if is_whole else source.read(index).labels
        except DataError as error:
            self._problems.append(error)
            return index, None
        truth = truth.astype(np.int32) if truth.dtype == np.uint16 else truth
        return index, (np.array(truth), np.array(prediction))

    def _placed(self, path: Path) -> NDArray[Any]:
        """Return a prediction for the whole sphere, at the size of the labels."""
        prediction, how, canvas = self._read(path), self._settings.resample, self.data.canvas
        if prediction.shape not in (canvas.full_shape, canvas.image_shape):
            size = width_height(prediction.shape)
            if how is None:
                remedy = "Give resample=nearest to score it at this size."
                expected = width_height(canvas.image_shape)
                raise DataError(path, found=size, expected=expected, remedy=remedy)
            self._resampled.add(size)
            interpolation: Any = "bilinear" if how == "linear" else "nearest"
            prediction = resize(prediction, canvas.image_shape, interpolation)
        is_placed = prediction.shape == canvas.full_shape
        return prediction if is_placed else canvas.place(prediction)

    def _read(self, path: Path) -> NDArray[Any]:
        settings, label_map = self._settings, self._map
        if label_map is None:
            if path.suffix.lower() == ".npz":
                raise DataError(path, found="an archive", expected="distances: .npy, EXR or PNG")
            depth = read_depth_m(path, settings.depth_scale, settings.depth_channel)
            return np.where(depth > 0, depth, np.float32(np.nan))
        if self.data.labels == PANOPTIC:
            labels, numbers = np.divmod(self.head.read(path), LABEL)
            return label_map.decode(labels, path) * np.int32(LABEL) + numbers
        if path.suffix.lower() not in _ARRAYS:
            return label_map.read_labels(path)
        array = _array(path)
        if array.ndim == 2 and array.dtype.kind in "iub":
            none = np.array(_NO_CLASS[1], np.int64)
            return label_map.decode(np.where(array < 0, none, array), path)
        count = len(label_map.names)
        axes = [axis for axis in (0, 2) if array.ndim == 3 and array.shape[axis] == count]
        if len(axes) != 1 or array.dtype.kind != "f":
            found = f"{array.dtype} of shape {array.shape}"
            expected = f"integers (H, W), or scores ({count}, H, W) or (H, W, {count})"
            raise DataError(path, found=found, expected=expected)
        best = array.argmax(axis=axes[0]) + 1
        known = np.isfinite(array.max(axis=axes[0]))
        return np.where(known, best, 0).astype(np.uint8)


def _array(path: Path) -> NDArray[Any]:
    """Read an array; of an archive its only one."""
    try:
        content: Any = np.load(path, allow_pickle=False)
        if isinstance(content, Mapping):
            (name,) = content
            content = content[name]
    except (ValueError, OSError, EOFError) as error:
        expected = "a .npy file, or a .npz file with one array"
        raise DataError(path, found=str(error), expected=expected) from error
    array: NDArray[Any] = content
    return array
