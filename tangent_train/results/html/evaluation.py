"""The report of an evaluation: its results as tables, its images, the curves of the training."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.metrics.segmentation import segmentation_scores
from tangent_train.results.html.page import write_report
from tangent_train.results.html.parts import Curve, Table
from tangent_train.results.segmentation import largest_loss, percent

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.results.html.images import EncodedImage

__all__ = [
    "evaluation_tables",
    "heat_table",
    "image_note",
    "training_curves",
    "write_evaluation_report",
]

_MOST_SCALAR_BYTES = 2**16
"""Of an event; longer ones hold pictures."""

_NAMES = {"miou": "mIoU", "macc": "mAcc"}
_VALIDATION = {
    "val/miou": "mIoU",
    "val/macc": "mAcc",
    "val/miou_solid_angle": "mIoU by solid angle",
    "val/macc_solid_angle": "mAcc by solid angle",
    "val/accuracy": "accuracy",
    "val/class_accuracy": "mean of the classes",
}
_CURVES = (
    ("Training loss", "loss", ("train/loss",)),
    ("Validation", "%", tuple(_VALIDATION)),
    ("Learning rate", "learning rate", ("lr-",)),
)


def write_evaluation_report(
    path: Path,
    results: dict[str, Any],
    class_names: Sequence[str],
    images: Iterable[EncodedImage],
    checkpoint: Path,
) -> None:
    """Write the report of an evaluation.

    Args:
        path: The HTML file.
        results: From `evaluation_results`.
        class_names: K + 1 names, the unknown class first.
        images: Some of the images that were scored.
        checkpoint: What was evaluated; curves are drawn where it lies in the folder of its run.
    """
    figures = [
        f"{name} {percent(results[key])}\u00a0%"
        for key, name in (("miou", "mIoU"), ("macc", "mAcc"))
    ]
    notes = [f"{', '.join(figures)} over {results['images']} {results['noun']}"]
    if results["miou_solid_angle"] is not None:
        solid = (percent(results[f"{key}_solid_angle"]) for key in _NAMES)
        notes.append("By solid angle: mIoU {}\u00a0%, mAcc {}\u00a0%.".format(*solid))
    notes += filter(None, [largest_loss(results)])
    notes.append(f"Checkpoint: {checkpoint}")
    write_report(
        path,
        f"Evaluation of {checkpoint.name}",
        tables=evaluation_tables(results),
        curves=training_curves(checkpoint.resolve().parent.parent),
        images=images,
        class_names=class_names,
        notes=notes,
    )


def evaluation_tables(results: dict[str, Any]) -> list[Table]:
    """All figures of an evaluation: overall, per class, by latitude, and who is taken for whom.

    Args:
        results: From `evaluation_results`.
    """
    on_sphere = bool(results["latitude_bands"])
    tables = [_overall(results, on_sphere=on_sphere)]
    if on_sphere:
        rows = [
            (
                "{}° … {}°".format(*band["latitude_deg"]),
                percent(band["miou"]),
                percent(band["macc"]),
            )
            for band in results["latitude_bands"]
        ]
        tables.append(Table("By latitude", ("latitude", "mIoU %", "mAcc %"), rows))
    return [*tables, _per_class(results, on_sphere=on_sphere), _confusion(results)]


def _overall(results: dict[str, Any], *, on_sphere: bool) -> Table:
    weights = {"by pixels": ""} | ({"by solid angle": "_solid_angle"} if on_sphere else {})
    rows = [
        (name, *(percent(results[f"{key}{suffix}"]) for key in _NAMES))
        for name, suffix in weights.items()
    ]
    absent = "do not count" if results["absent_class"] == "skip" else "count as 0"
    note = f"{results['images']} {results['noun']}; classes without truth {absent} in the means."
    return Table("Overall", ("mean", "mIoU %", "mAcc %"), rows, note)


def _per_class(results: dict[str, Any], *, on_sphere: bool) -> Table:
    columns = {"iou": "IoU %", "accuracy": "acc. %", "share": "pixels %"}
    if on_sphere:
        columns |= {
            "iou_solid_angle": "IoU % by solid angle",
            "accuracy_solid_angle": "acc. % by solid angle",
        }
    rows = [
        (entry["class"], *(percent(entry[column]) for column in columns))
        for entry in results["classes"]
    ]
    return Table("Per class", ("class", *columns.values()), rows)


def _confusion(results: dict[str, Any]) -> Table:
    names = [entry["class"] for entry in results["classes"]]
    counts = np.asarray(results["confusion"], np.float64)[1:, 1:]
    totals = counts.sum(axis=1, keepdims=True)
    shares = np.divide(counts, totals, out=np.zeros_like(counts), where=totals > 0)
    return heat_table(names, shares, "pixels")


def heat_table(names: Sequence[str], shares: NDArray[np.float64], noun: str) -> Table:
    """A confusion matrix as a table.

    Args:
        names: Of the classes.
        shares: ``(K, K)`` of 1, rows truth, columns prediction.
        noun: What was counted, in the plural.
    """
    rows = [
        (name, *(f"{100 * share:.0f}" if share >= 0.005 else "" for share in row))
        for name, row in zip(names, shares, strict=True)
    ]
    note = f"Rows: truth; columns: prediction; % of the {noun} of the row."
    return Table("Confusion", ("", *names), rows, note, shades=shares.tolist())


def image_note(
    truth: NDArray[np.integer], prediction: NDArray[np.integer], class_count: int
) -> str:
    """The scores of one image, for its place in the viewer.

    Args:
        truth: Class indices, 0 unknown; of any shape.
        prediction: Likewise, of the same shape.
        class_count: K + 1.

    Returns:
        Its mIoU over the classes it holds and the share of right pixels; nothing without truth.
    """
    pairs = truth.astype(np.int64).ravel() * class_count + prediction.ravel()
    counts = np.bincount(pairs, minlength=class_count**2).reshape(class_count, class_count)
    known = counts[1:].sum()
    if not known:
        return ""
    right = counts.diagonal()[1:].sum() / known
    miou = segmentation_scores(counts).miou
    return f"mIoU {percent(miou)}\u00a0%, {percent(right)}\u00a0% of pixels right"


def training_curves(run_folder: Path) -> list[Curve]:
    """Loss, validation scores and learning rate that a training logged.

    Args:
        run_folder: Of the training; its event files are read, if it has any.

    Returns:
        A curve for each of them that was logged.
    """
    logged = _scalars(run_folder / "tensorboard")
    return [
        curve
        for title, label, wanted in _CURVES
        if (curve := _curve(title, label, {t: v for t, v in logged.items() if _is_in(t, wanted)}))
    ]


def _scalars(logs: Path) -> dict[str, dict[int, float]]:
    """Values by tag and step of TensorBoard's event files.

    Its own reader checks every byte in Python, 6 MB/s, and most bytes are pictures: here longer
    records are skipped. A record is its length, 8 bytes, and a checksum, 4; an `Event`; a checksum.
    """
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
    from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[import-untyped]

    logged: dict[str, dict[int, float]] = {}
    for path in sorted(logs.glob("events.out.tfevents.*")):
        whole = path.stat().st_size
        with path.open("rb") as file:
            while len(head := file.read(12)) == 12:
                size = int.from_bytes(head[:8], "little")
                if file.tell() + size + 4 > whole:
                    break  # cut off, or no such file
                if size > _MOST_SCALAR_BYTES:
                    file.seek(size + 4, 1)
                    continue
                try:
                    event = Event.FromString(file.read(size + 4)[:-4])
                except DecodeError:
                    break
                for value in event.summary.value:
                    if value.HasField("simple_value"):
                        logged.setdefault(value.tag, {})[event.step] = value.simple_value
    return logged


def _is_in(tag: str, wanted: Sequence[str]) -> bool:
    return any(tag.startswith(name) if name.endswith("-") else tag == name for name in wanted)


def _curve(title: str, label: str, logged: dict[str, dict[int, float]]) -> Curve | None:
    """Series over the steps at which any of them was logged."""
    steps = sorted({step for values in logged.values() for step in values})
    factor = 100 if label == "%" else 1
    series = {
        _series_name(tag): [factor * values.get(step, math.nan) for step in steps]
        for tag, values in logged.items()
    }
    return Curve(title, label, steps, series, x_label="step") if series else None


def _series_name(tag: str) -> str:
    return "training" if tag.startswith("train/") else _VALIDATION.get(tag, tag)
