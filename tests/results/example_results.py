"""Evaluation results with given scores, and run folders that contain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from tangent_train.heads import ClassesHead
from tangent_train.results.evaluation import EvaluationResult, flat_settings
from tangent_train.results.published import facts

NAMES = ("wall", "floor", "sofa")
BANDS = ((45.0, 90.0), (-90.0, 45.0))
PROTOCOL = facts("paper_512")
SETTINGS = {
    "name": "mine",
    "seed": 0,
    "level": 7,
    "data": {
        "_target_": "datamodules.stanford2d3ds.panoramas.Stanford2D3DS",
        "fold": 1,
        "inputs": ["rgb", "depth"],
        "test_rotation": None,
        "root": "/data",
    },
    "representation": {"_target_": "rendering.TangentRepresentation", "base_level": 0},
    "optimizer": {"lr": 0.01},
}


def example_result(
    scores: Sequence[float | None],
    names: Sequence[str] = NAMES,
    bands: Sequence[float] = (),
    protocol: Mapping[str, str] = {},
    folds: Sequence[int] = (1, 2, 3),
    **settings: Any,
) -> EvaluationResult:
    """Return a result with one value for all scores of a class, and the means of these.

    Args:
        scores: Score of each class.
        names: Name of each class.
        bands: Score of each band.
        protocol: Facts of the protocol, e.g. `PROTOCOL`.
        folds: Folds of the data set.
        settings: Changes of `SETTINGS`, two underscores for a point.
    """
    config = OmegaConf.create(SETTINGS)
    for name, value in settings.items():
        OmegaConf.update(config, name.replace("__", "."), value)
    flat = flat_settings(OmegaConf.to_container(config))  # type: ignore[arg-type]
    present = [value for value in scores if value is not None]
    columns, mean = ClassesHead.columns, sum(present) / len(present)
    of_class = [column.of_class for column in columns.values() if column.of_class]
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
        folds=folds,
        settings=flat,
        folder=Path(f"/runs/{flat['data.fold']}_{flat['seed']}"),
    )


def write_run(folder: Path, result: EvaluationResult) -> Path:
    """Write the results and settings of a run."""
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(result.json())
    settings: Any = OmegaConf.create()
    for name, value in result.settings.items():
        OmegaConf.update(settings, name, value)
    OmegaConf.save(settings, folder / "config.yaml")
    return folder


def without_solid_angle(result: EvaluationResult) -> EvaluationResult:
    """Return a result like that of photos."""
    scores = {k: None if k.endswith("_solid_angle") else v for k, v in result.scores.items()}
    return replace(result, scores=scores)
