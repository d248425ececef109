"""Runs of a transfer's stages with figures given, and the reading of its tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from tangent_train.results.reports.runs import Run
from tangent_train.results.transfer.levels import LevelReport, LevelResult, gather_levels
from tangent_train.results.transfer.report import Row, StageResult, TransferReport

NAMES = ("wall", "floor")
REAL = "datamodules.Stanford2D3DS"
BANDS = ((45.0, 90.0), (-90.0, 45.0))


def make_run(
    miou: float,
    *,
    classes: tuple[float | None, ...] | None = None,
    names: tuple[str, ...] = NAMES,
    bands: tuple[float | None, ...] = (),
    photos: bool = False,
    settings: Mapping[str, Any] | None = None,
) -> Run:
    """All means equal, all figures of a class equal; accuracies are 0.1 higher."""
    of_classes = (miou,) * len(names) if classes is None else classes

    def higher(value: float | None) -> float | None:
        return None if value is None else value + 0.1

    results: dict[str, Any] = {
        "images": 5,
        "miou": miou,
        "macc": miou + 0.1,
        "miou_solid_angle": None if photos else miou / 2,
        "macc_solid_angle": None if photos else miou / 2 + 0.1,
        "classes": [
            {
                "class": name,
                "iou": value,
                "accuracy": higher(value),
                "iou_solid_angle": value,
                "accuracy_solid_angle": value,
            }
            for name, value in zip(names, of_classes, strict=True)
        ],
    }
    if bands:
        results["latitude_bands"] = [
            {"latitude_deg": [int(south), int(north)], "miou": value, "macc": value}
            for (south, north), value in zip(BANDS, bands, strict=True)
        ]
    data = {
        "data._target_": "datamodules.SynthRooms",
        "data.inputs": ["rgb", "depth"],
        "level": 8,
        "representation.base_level": 1,
    }
    return Run(Path(f"/runs/{miou}"), {**data, **(settings or {})}, results)


def stage(
    name: str, run: Run, fold: int | None = 1, seed: int = 0, representation: str = ""
) -> StageResult:
    """P… on photos, all others on panoramas; FT-n as the name says."""
    on: Literal["photos", "panoramas"] = "photos" if name.startswith("P") else "panoramas"
    _, tuned, epochs = name.partition("-FT-")
    way = representation or ("perspective" if on == "photos" else "tangent")
    return StageResult(name, on, int(epochs) if tuned else 0, way, fold, seed, run)


def both(photos: dict[tuple[int, int], float], sphere: dict[tuple[int, int], float]) -> list[Any]:
    """P and S by fold and seed."""
    return [
        *(stage("P", make_run(v, photos=True), *key) for key, v in photos.items()),
        *(stage("S", make_run(v, bands=(v, v / 2)), *key) for key, v in sphere.items()),
    ]


def levels(figures: dict[tuple[int, int, int], float], trained: float) -> LevelReport:
    """By level, fold and seed."""
    results = [
        LevelResult(*key, make_run(value, settings={"level": key[0]}))
        for key, value in figures.items()
    ]
    return gather_levels(results, trained)


def by_name(report: TransferReport) -> dict[str, Row]:
    return {row.name: row for row in report.rows}


def markdown_tables(text: str) -> dict[str, list[list[str]]]:
    """Cells of every table by its heading, header first, without the rule; checks their form."""
    tables: dict[str, list[list[str]]] = {}
    heading, key, rule = "", "", False
    for found in text.splitlines():
        if found.startswith("#"):
            heading = found.lstrip("# ")
        if not found.startswith("|"):
            rule = False
            continue
        cells = found.strip("| ").split(" | ")
        if not rule and set(found) <= set("| -:"):
            rule = True
            assert len(cells) == len(tables[key][0])
            continue
        if not rule:
            key = cells[0] if cells[0] == "stage" and cells[-1] == "run" else heading
            assert key not in tables
            tables[key] = []
        tables[key].append(cells)
        assert len(cells) == len(tables[key][0])
    return tables
