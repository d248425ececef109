"""What ``python -m benchmarks accuracy`` found, as JSON and Markdown."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.accuracy_folder import results_of
from benchmarks.accuracy_rows import EXPERIMENT, ORIENTATIONS, PLAIN
from tangent_train.files import write_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.accuracy_folder import AccuracyFolder
    from benchmarks.accuracy_rows import Row, Variant

__all__ = ["TURNED", "UPRIGHT", "Line", "found_lines", "goals", "write_tables"]

UPRIGHT, TURNED = "null", "so3"
_AHEAD, _KEPT = 0.10, 0.95
"""Goals of turned panoramas: the lead over equirectangular images, the upright score kept."""


class Line(NamedTuple):
    """A line of the table: a row evaluated in one way.

    Attributes:
        row: It.
        variant: How it was evaluated.
        scores: mIoU of every seed, a share of 1, by orientation.
        training: Of one seed: epochs, seconds.
        speed: What was measured of its epochs.
    """

    row: Row
    variant: Variant
    scores: dict[str, list[float]]
    training: dict[str, Any]
    speed: dict[str, Any]

    @property
    def name(self) -> str:
        """Of row and variant."""
        return self.row.name if self.variant is PLAIN else f"{self.row.name}, {self.variant.name}"

    def mean(self, orientation: str) -> float | None:
        """Over the seeds."""
        found = self.scores[orientation]
        return fmean(found) if found else None

    def spread(self, orientation: str) -> float | None:
        """Sample standard deviation over the seeds; None of one alone."""
        found = self.scores[orientation]
        return stdev(found) if len(found) > 1 else None


def found_lines(folder: AccuracyFolder, rows: Sequence[Row], seeds: int) -> list[Line]:
    """What is there of these rows and the first seeds.

    Args:
        folder: Where it is.
        rows: In the order of the table.
        seeds: How many.
    """
    lines = []
    for row in rows:
        runs = [run for seed in range(seeds) if (run := folder.run(row, seed)) is not None]
        for variant in (PLAIN, *row.variants) if runs else ():
            found = [results_of(run, variant) for run in runs]
            scores = {o: [r[o]["miou"] for r in found if o in r] for o in ORIENTATIONS}
            if any(scores.values()):
                speed = folder.speed(row) or {}
                lines.append(Line(row, variant, scores, runs[0]["training"], speed))
    return lines


def write_tables(folder: AccuracyFolder, lines: Sequence[Line]) -> None:
    """Write ``accuracy.json`` and ``accuracy.md``, each atomically."""
    content = {
        "plan": asdict(folder.plan()),
        "lines": [_plain(folder, line) for line in lines],
        "goals": goals(lines),
    }
    write_text(folder.path / "accuracy.json", json.dumps(content, indent=1) + "\n")
    write_text(folder.path / "accuracy.md", "\n".join(_markdown(folder, lines)) + "\n")


def _plain(folder: AccuracyFolder, line: Line) -> dict[str, Any]:
    return {
        "row": line.row.name,
        "about": line.row.about,
        "variant": line.variant.name,
        "evaluated_with": list(line.variant.settings),
        "command": shlex.join(command(folder, line.row)),
        "miou": {
            name: {"mean": line.mean(name), "spread": line.spread(name), "seeds": found}
            for name, found in line.scores.items()
        },
        "epochs": line.training["epochs"],
        "seconds": line.training["epochs"] * line.speed["epoch_seconds"],
        **{f"{name}_per_second": rate for name, rate in rates(line).items()},
        "parameters": line.speed["parameters"],
    }


def command(folder: AccuracyFolder, row: Row) -> list[str]:
    """What trains a row of this folder, without the seed."""
    others = folder.plan().overrides()[1:]
    epochs = f"trainer.max_epochs={folder.epochs(row)}"
    return ["tangent-train", EXPERIMENT, *others, *row.settings, epochs]


def rates(line: Line) -> dict[str, float]:
    """Panoramas, images and pixels per second of training."""
    speed = line.speed
    counted = ("panoramas", "images", "pixels")
    return {name: speed[name] / speed["epoch_seconds"] for name in counted}


def goals(lines: Sequence[Line]) -> list[str]:
    """How far tangent images are ahead of equirectangular ones, as sentences.

    The best line counts of either: first of those that take panoramas as they come, then of those
    that may find out from the image where up is. Those that are told it do not count.
    """
    found = [line for line in lines if not line.variant.told_up]
    come = [line for line in found if not line.variant.upright]
    return [
        f"{how}: {sentence}"
        for how, group in (("As they come", come), ("Up may be found in the image", found))
        if group is come or len(group) > len(come)
        for sentence in _goals(group)
    ]


def _goals(lines: Sequence[Line]) -> list[str]:
    said = []
    for orientation, goal in ((UPRIGHT, 0.0), (TURNED, _AHEAD)):
        tangent, equirect = (_best(lines, orientation, equirect=kind) for kind in (False, True))
        if tangent is None or equirect is None:
            continue
        ahead = (tangent.mean(orientation) or 0) - (equirect.mean(orientation) or 0)
        said.append(
            f"{ORIENTATIONS[orientation]}: {tangent.name} {_cell(tangent, orientation)}, "
            f"{equirect.name} {_cell(equirect, orientation)}: {100 * ahead:+.1f} mIoU "
            f"(the goal is {100 * goal:+.0f})."
        )
    best = _best(lines, TURNED, equirect=False)
    upright = None if best is None else best.mean(UPRIGHT)
    if best is not None and upright:
        kept = (best.mean(TURNED) or 0) / upright
        said.append(
            f"{best.name} keeps {100 * kept:.1f} % of its upright score under "
            f"{ORIENTATIONS[TURNED]} (the goal is {100 * _KEPT:.0f} %)."
        )
    return said


def _best(lines: Sequence[Line], orientation: str, *, equirect: bool) -> Line | None:
    known = [line for line in lines if line.row.equirect == equirect and line.scores[orientation]]
    return max(known, key=lambda line: line.mean(orientation) or 0, default=None)


def _cell(line: Line, orientation: str) -> str:
    mean, spread = line.mean(orientation), line.spread(orientation)
    if mean is None:
        return "–"
    return f"{100 * mean:.1f}" + ("" if spread is None else f" ± {100 * spread:.1f}")


def _markdown(folder: AccuracyFolder, lines: Sequence[Line]) -> list[str]:
    plan = folder.plan()
    scored = [*ORIENTATIONS.values()]
    head = ["row", *scored, "seeds", "panoramas/s", "images/s", "Mpx/s", "epochs", "parameters"]
    return [
        f"{plan.seconds:g} s of training each, level {plan.level}, made rooms of "
        f"{plan.rooms_height} rows, {plan.device}. mIoU in percent, mean ± standard deviation "
        "over seeds. Columns say how test panoramas are turned.",
        "",
        _line(head),
        _line(["---", *["---:"] * (len(head) - 1)]),
        *(_line(_cells(line)) for line in lines),
        "",
        *(f"- {sentence}" for sentence in goals(lines)),
        "",
        _line(["row", "what it is", "command"]),
        _line(["---"] * 3),
        *(
            _line([line.name, line.row.about, f"`{shlex.join(command(folder, line.row))}`"])
            if line.variant is PLAIN
            else _line([line.name, "evaluated so", f"`{shlex.join(line.variant.settings)}`"])
            for line in lines
        ),
    ]


def _cells(line: Line) -> list[str]:
    cells = [line.name, *(_cell(line, orientation) for orientation in ORIENTATIONS)]
    cells.append(str(max(len(found) for found in line.scores.values())))
    if line.variant is not PLAIN:
        return [*cells, *[""] * 5]
    rate = rates(line)
    return [
        *cells,
        f"{rate['panoramas']:.1f}",
        f"{rate['images']:.1f}",
        f"{rate['pixels'] / 1e6:.2f}",
        str(line.training["epochs"]),
        f"{line.speed['parameters']:,}",
    ]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
