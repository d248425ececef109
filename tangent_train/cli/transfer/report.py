"""The tables and the chart at the end of a transfer."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from tangent_train.cli.transfer.stages import STUDY, Stage, checked_study
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.registry import make
from tangent_train.results.comparisons import levels_report, transfer_report
from tangent_train.results.record import Record, load_record

__all__ = ["trained_level", "write_report"]

_MADE_BY = "tangent-transfer"


def write_report(config: DictConfig, folder: Path, stages: Sequence[Stage]) -> list[str]:
    """Print the table, write ``.md``, ``.csv``, ``.json`` and ``.png``.

    Args:
        config: The composed ``transfer.yaml``.
        folder: Where to.
        stages: Finished ones.

    Returns:
        What is to be said after the table.

    Raises:
        DataError: The results of a stage cannot be used.
    """
    found: dict[Any, list[Record]] = defaultdict(list)
    study = checked_study(config)
    for stage in sorted(stages, key=lambda s: (s.epochs, s.on != "photos", s.fold or 0, s.seed)):
        if not study or stage.level is not None:
            found[stage.level if study else stage.name].append(load_record(stage.folder))
    if study:
        name, report = STUDY, levels_report(found, trained_level(config), _MADE_BY)
    else:
        name, report = "transfer", transfer_report(found, _MADE_BY)
    report.write(folder, name)
    Console(highlight=False).print(report.tables()[0].terminal())
    notes = [f"- {note}" for note in report.all_notes()]
    return [*notes, f"Tables and a chart: {folder / name}.md, .csv, .json, .png"]


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
