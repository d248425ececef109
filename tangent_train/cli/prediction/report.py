"""What tangent-predict says about its results: on the terminal, in files, in the report."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table as TerminalTable

from tangent_train.results.html import Table, ViewerImage, encode_image, write_report

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.cli.prediction.settings import PredictSettings
    from tangent_train.inference.labellers import Labelled
    from tangent_train.inference.outputs import OutputFolder
    from tangent_train.results.html import EncodedImage

__all__ = ["shares_table", "shown_image", "summary", "what_happens", "write_prediction_report"]

Entry = dict[str, Any]
"""What is known of an image: file, name and figures, or file, name and error."""


def what_happens(settings: PredictSettings, trained: TrainedNetwork, count: int) -> str:
    """One line before the work begins."""
    level = trained.level if settings.level is None else settings.level
    shown = "of each image" if level == "image" else str(level)
    noun = "panorama" if settings.projection == "equirectangular" else "photo"
    return (
        f"{count} {noun}{'s' if count != 1 else ''}, {len(trained.class_names) - 1} classes, "
        f"level {shown} (the network's is {trained.level}), blend {settings.blend}, "
        f"{', '.join(trained.inputs)}"
    )


def shown_image(entry: Entry, found: Labelled, class_count: int) -> EncodedImage:
    """An image for the report, a few hundred kilobytes to some megabytes."""
    rgb, labels = found.rgb, found.labels
    if found.area is not None:
        rgb, labels = found.area.place(rgb), found.area.place(labels)
    note = f"{entry['rows']}×{entry['columns']}, level {entry['level']}"
    sphere = found.area is not None
    image = ViewerImage(entry["name"], rgb, labels, None, sphere=sphere, note=note)
    return encode_image(image, class_count)


def summary(
    settings: PredictSettings, trained: TrainedNetwork, entries: list[Entry]
) -> dict[str, Any]:
    """The content of ``summary.json``."""
    return {
        "checkpoint": str(settings.checkpoint),
        "projection": settings.projection,
        "level": trained.level if settings.level is None else settings.level,
        "base_level": settings.base_level,
        "blend": settings.blend,
        "rotations": settings.rotations,
        "upright": settings.upright,
        "max_tilt_deg": settings.max_tilt_deg,
        "classes": _mean_shares(entries, trained.class_names),
        "images": entries,
    }


def shares_table(entries: Sequence[Entry], class_names: Sequence[str]) -> TerminalTable:
    """Mean shares of the classes, the largest first, for the terminal."""
    shares = sorted(_mean_shares(entries, class_names).items(), key=lambda item: -item[1])
    table = TerminalTable(title="Mean over the images")
    table.add_column("class")
    table.add_column("solid angle %", justify="right")
    for name, share in shares:
        table.add_row(escape(name), _percent(share))
    return table


def write_prediction_report(
    output: OutputFolder, entries: Sequence[Entry], shown: Sequence[EncodedImage], how: str
) -> None:
    """Write ``report.html``.

    Args:
        output: Where to.
        entries: Of all images.
        shown: Some of them, to look at.
        how: From `what_happens`.
    """
    done = [entry for entry in entries if "error" not in entry]
    failed = [entry for entry in entries if "error" in entry]
    names = output.class_names[1:]
    shares = [[e["name"], *(_percent(e["classes"][name]) for name in names)] for e in done]
    mean = _mean_shares(done, output.class_names)
    shares.append(["mean", *(_percent(mean[name]) for name in names)])
    header = ["image", *names]
    tables = [Table("Solid angle of the classes, %", header, shares, "Of what is labelled.")]
    if any("seam_ratio" in entry for entry in done):
        tables.append(_seams([entry for entry in done if "seam_ratio" in entry]))
    if failed:
        rows = [[entry["name"], entry["error"]] for entry in failed]
        tables.append(Table("Images that could not be used", ["image", "why"], rows))
    notes = [how]
    if len(shown) < len(done):
        notes.append(f"{len(shown)} of {len(done)} images are shown (report=…).")
    write_report(
        output.path / "report.html",
        "Predictions",
        tables=tables,
        images=shown,
        class_names=output.class_names,
        notes=notes,
    )


def _seams(entries: Sequence[Entry]) -> Table:
    rows = [
        [
            entry["name"],
            *(_percent(entry[name]) for name in ("seam_border", "seam_inside")),
            _number(entry["seam_ratio"], 1),
        ]
        for entry in entries
    ]
    header = ["image", "across borders %", "inside %", "ratio"]
    note = "How often neighbouring pixels differ; where borders do not show, the ratio is near 1."
    return Table("Seams between tangent images", header, rows, note)


def _mean_shares(entries: Sequence[Entry], class_names: Sequence[str]) -> dict[str, float]:
    done = [entry["classes"] for entry in entries if "error" not in entry]
    return {name: sum(s[name] for s in done) / max(1, len(done)) for name in class_names[1:]}


def _percent(share: float | None) -> str:
    return _number(share, 100)


def _number(value: float | None, factor: float) -> str:
    return (
        "–"
        if value is None or math.isnan(value)
        else f"{factor * value:.{1 if factor > 1 else 2}f}"
    )
