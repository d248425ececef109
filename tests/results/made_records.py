"""Records with given scores, and runs on disk that hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from tangent_train.config.setting_rules import flat_settings
from tangent_train.heads import ClassesHead
from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.published import facts

NAMES = ("wall", "floor", "sofa")
BANDS = ((45.0, 90.0), (-90.0, 45.0))
PROTOCOL = facts("paper_512")
SETTINGS = {
    "name": "mine",
    "seed": 0,
    "level": 7,
    "data": {
        "_target_": "datamodules.Stanford2D3DS",
        "fold": 1,
        "inputs": ["rgb", "depth"],
        "test_rotation": None,
        "root": "/data",
    },
    "representation": {"_target_": "rendering.TangentRepresentation", "base_level": 0},
    "optimizer": {"lr": 0.01},
}


def made_record(
    scores: Sequence[float | None],
    names: Sequence[str] = NAMES,
    bands: Sequence[float] = (),
    protocol: Mapping[str, str] = {},
    **settings: Any,
) -> EvaluationResult:
    """Make a record with one value for all scores of a class, and the means of these.

    Args:
        scores: Score of each class.
        names: Name of each class.
        bands: Score of each band.
        protocol: Facts of the protocol, e.g. `PROTOCOL`.
        settings: Changes of `SETTINGS`, two underscores for a point.
    """
    config = OmegaConf.create(SETTINGS)
    for name, value in settings.items():
        OmegaConf.update(config, name.replace("__", "."), value)
    flat = dict(flat_settings(OmegaConf.to_container(config)))  # type: ignore[arg-type]
    present = [value for value in scores if value is not None]
    columns, mean = ClassesHead.columns, sum(present) / len(present)
    of_class = [heading.of_class for heading in columns.values()]
    return EvaluationResult(
        "panoramas",
        5,
        columns,
        {"miou": mean, **dict.fromkeys(columns, mean)},
        [
            {"class": name, "iou": value, **dict.fromkeys(of_class, value), "share": 0.1}
            for name, value in zip(names, scores, strict=True)
        ],
        [
            {"latitude_deg": list(band), "miou": value, "macc": value}
            for band, value in zip(BANDS, bands, strict=False)
        ],
        protocol=protocol,
        settings=flat,
        folder=Path(f"/runs/{flat['data.fold']}_{flat['seed']}"),
    )


def write_run(folder: Path, record: EvaluationResult) -> Path:
    """The run that a record is of: its results and settings."""
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(record.json())
    settings: Any = OmegaConf.create()
    for name, value in record.settings.items():
        OmegaConf.update(settings, name, value)
    OmegaConf.save(settings, folder / "config.yaml")
    return folder


def without_solid_angle(record: EvaluationResult) -> EvaluationResult:
    """As photos are scored."""
    means = {k: None if k.endswith("_solid_angle") else v for k, v in record.scores.items()}
    return replace(record, scores=means)
