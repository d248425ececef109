"""The tables and the chart at the end of a transfer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from tangent_train.cli.transfer.stages import STUDY, Stage, checked_study
from tangent_train.files import write_bytes, write_text
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.registry import make
from tangent_train.results.reports.runs import Run, load_run
from tangent_train.results.transfer import chart, levels
from tangent_train.results.transfer import tables as transfer_tables
from tangent_train.results.transfer.report import StageResult, gather

__all__ = ["trained_level", "write_report"]


class _Report(NamedTuple):
    """What both kinds of report are written from."""

    name: str
    texts: dict[str, str]
    png: bytes
    tables: Sequence[Table]
    notes: Sequence[str]


def write_report(config: DictConfig, folder: Path, stages: Sequence[Stage]) -> list[str]:
    """Print the tables, write ``.md``, ``.csv``, ``.json`` and ``.png``.

    Args:
        config: The composed ``transfer.yaml``.
        folder: Where to.
        stages: Finished ones.

    Returns:
        What is to be said after the tables.

    Raises:
        DataError: The results of a stage cannot be used.
    """
    report = _levels(config, stages) if checked_study(config) else _transfer(stages)
    for suffix, text in report.texts.items():
        write_text(folder / f"{report.name}.{suffix}", text)
    write_bytes(folder / f"{report.name}.png", report.png)
    console = Console(highlight=False)
    for table in report.tables:
        console.print(table)
    notes = [f"- {note}" for note in report.notes]
    return [*notes, f"Tables and a chart: {folder / report.name}.md, .csv, .json, .png"]


def _transfer(stages: Sequence[Stage]) -> _Report:
    report = gather(
        [
            StageResult(s.name, s.on, s.epochs, s.representation, s.fold, s.seed, _run(s))
            for s in stages
        ]
    )
    texts = {
        "json": transfer_tables.transfer_json(report),
        "md": transfer_tables.transfer_markdown(report),
        "csv": transfer_tables.transfer_csv(report),
    }
    notes = transfer_tables.transfer_notes(report)
    tables = transfer_tables.transfer_tables(report)
    return _Report("transfer", texts, chart.transfer_png(report), tables, notes)


def _levels(config: DictConfig, stages: Sequence[Stage]) -> _Report:
    results = [
        levels.LevelResult(s.level, s.fold, s.seed, _run(s)) for s in stages if s.level is not None
    ]
    report = levels.gather_levels(results, trained_level(config))
    texts = {
        "json": levels.levels_json(report),
        "md": levels.levels_markdown(report),
        "csv": levels.levels_csv(report),
    }
    notes = levels.levels_notes(report)
    tables = levels.levels_tables(report)
    return _Report(STUDY, texts, chart.levels_png(report), tables, notes)


def _run(stage: Stage) -> Run:
    return load_run(stage.folder)


def trained_level(config: DictConfig) -> float:
    """The level at which the panoramas' images have the focal length of the photos' crops.

    That of a crop is ``f' = W' / (2 tan(Ω'/2))`` pixels (paper, supplement, "Camera
    normalization"), that of a tangent image 1/p: every level doubles it. The paper's 45° and 128
    pixels for level 8 are as fine as level 8.42 at b = 1.

    Args:
        config: The composed ``transfer.yaml``.

    Returns:
        The photos' own level where their field of view is not set.
    """
    settings: Any = OmegaConf.to_container(config, resolve=True)
    photos = make(settings["photos"]["representation"], "photos.representation")
    if not hasattr(photos, "fov_deg"):
        return float(config.photos.representation.get("level", config.level))
    focal = camera_matrix_from_fov(photos.fov_deg, photos.image_size)[0, 0]
    panoramas = make(settings["representation"], "representation")
    grid = getattr(panoramas, "grid", None)
    pitch = math.pi / panoramas.erp_height if grid is None else grid.pitch
    return float(config.level + math.log2(focal * pitch))
