"""``tangent-transfer`` of a network that knows no run, with real evaluations, small ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.tiny_runs import SMALL_ROOMS, Run, results
from tests.inference.trained import write_checkpoint

_ROOMS = [text for text in SMALL_ROOMS if text.startswith(("data.rooms.", "trainer."))]
_MAP = {"classes": {"floor": ["dark"], "ceiling": ["bright"], "wall": ["green"]}}
_VIEWS = {
    "S": [],
    "S-coarse": ["level=3", "representation.erp_height=32", "representation.blend=feather"],
    "S-erp": ["representation=erp", "representation.rows=24", "representation.erp_height=32"],
}
_CONDITIONS = {"": [], "-rotated": ["data.test_rotation=so3"]}
_COMPARE = "compare=[{name: coarse, level: 3, blend: feather}, {name: erp, option: erp, rows: 24}]"


def test_every_row_is_that_of_an_evaluation(
    tmp_path: Path, rooms: str, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    network = f"checkpoint={write_checkpoint(tmp_path / 'photo.ckpt')}"
    (tmp_path / "map.json").write_text(json.dumps(_MAP))
    settings = [network, *_ROOMS, rooms, "class_map=map.json", "panels=0"]
    conditions = "conditions=[upright, {name: rotated, test_rotation: so3}]"
    run("transfer", *settings, _COMPARE, conditions, "name=zero")
    found = tmp_path / "runs" / "transfer" / "zero"
    stages = found / "fold_1" / "seed_0"
    evaluated: dict[str, Any] = {}
    for view, of_view in _VIEWS.items():
        for condition, of_data in _CONDITIONS.items():
            folder = f"hydra.run.dir={tmp_path / 'again'}"
            run("evaluate", *settings, "data=synthrooms", *of_view, *of_data, folder)
            evaluated[view + condition] = results(tmp_path / "again")
            assert results(stages / (view + condition)) == evaluated[view + condition]
    assert {path.name for path in stages.iterdir()} == evaluated.keys()
    rows = {row["row"]: row for row in json.loads((found / "transfer.json").read_text())["rows"]}
    assert rows.keys() == evaluated.keys()
    assert {row["class map"] for row in rows.values()} == {"map.json"}
    confusions = [np.asarray(evaluated[view]["confusion"]) for view in _VIEWS]
    for matrix in confusions:  # all on the same labels
        np.testing.assert_array_equal(matrix.sum(axis=1), confusions[0].sum(axis=1))
    assert len({str(matrix.tolist()) for matrix in confusions}) == len(_VIEWS), "other views"

    tables = (found / "transfer.csv").read_text()
    capsys.readouterr()
    (stages / "S-erp" / "results.json").unlink()
    run("transfer", *settings, _COMPARE, conditions, "name=zero")
    assert capsys.readouterr().out.count("finished before") == len(rows) - 1
    assert (found / "transfer.csv").read_text() == tables


def test_what_does_not_fit_is_said_before_the_first_evaluation(
    tmp_path: Path, rooms: str, run: Run
) -> None:
    network = f"checkpoint={write_checkpoint(tmp_path / 'photo.ckpt')}"
    (tmp_path / "map.json").write_text(json.dumps({"classes": {"roof": ["dark"]}}))
    settings = [network, *_ROOMS, rooms]
    for given, message in {
        "class_map=null": r"stage S: data, for .*photo\.ckpt: found class names .*class_map=",
        "class_map=map.json": r"stage S: class_map=map\.json: found target classes roof",
        "conditions=[{name: odd, upright: down}]": r"stage S-odd: data\.upright: found down",
        "compare=[{name: tall, option: erp, erp_height: 99}]": r"stage S.*99",
    }.items():
        typed = [] if given.startswith("class_map") else ["class_map=good.json"]
        (tmp_path / "good.json").write_text(json.dumps(_MAP))
        with pytest.raises(SystemExit, match=message):
            run("transfer", *settings, *typed, given)
    assert not list(tmp_path.glob("runs/transfer/*/fold_1"))
