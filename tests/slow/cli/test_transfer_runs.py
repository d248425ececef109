"""``tangent-transfer`` with real runs, small ones."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.cli.pretended_runs import HERE, OF_SEED_0, SETTINGS
from tests.cli.tiny_runs import SMALL_ROOMS, Run, results
from tests.datamodules.folder.folder_format import write_classes, write_data_set
from tests.datamodules.folder.photo_format import write_photo, write_photos
from tests.inference.trained import write_checkpoint


def test_real_runs_from_photos_to_panoramas(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my" / "network").mkdir(parents=True)
    (tmp_path / "my" / "network" / "plain.yaml").write_text(
        "_target_: torch.nn.Conv2d\nin_channels: 4\nout_channels: 13\nkernel_size: 1\n"
    )
    network = (*SETTINGS, "network=plain", "compare=[]", "trainer.max_epochs=2", "--config-dir=my")
    run("transfer", *network)
    stages = ["P", "S", "P-FT-1", "S-FT-1"]
    found = {name: json.loads((OF_SEED_0 / name / "results.json").read_text()) for name in stages}
    assert [found[name]["images"] for name in stages] == [4, 2, 4, 2], "photos, panoramas"
    assert found["S"]["confusion"] != found["S-FT-1"]["confusion"]
    p, tuned = (
        torch.load(OF_SEED_0 / name / "checkpoints" / "last.ckpt", weights_only=True)
        for name in ("P", "S-FT-1")
    )
    assert tuned["config"]["optimizer"]["lr"] == 3e-4
    assert tuned["config"]["representation"]["level"] == p["config"]["representation"]["level"]
    assert tuned["epoch"] == 0
    (optimizer,) = tuned["optimizer_states"]
    assert int(optimizer["state"][0]["step"]) == tuned["global_step"] > 0, "a new optimizer"
    assert not torch.equal(tuned["state_dict"]["network.weight"], p["state_dict"]["network.weight"])

    before = (HERE / "transfer.csv").read_text()
    (OF_SEED_0 / "S-FT-1" / "results.json").unlink()
    shutil.rmtree(OF_SEED_0 / "S")
    capsys.readouterr()
    run("transfer", *network)
    out = capsys.readouterr().out
    assert out.count("finished before") == 2
    assert (HERE / "transfer.csv").read_text() == before, "the same figures again"
    left = {path.name for path in tmp_path.iterdir() if path.name[0] != "."}  # those are coverage's
    assert left == {"data", "my", "runs"}


_SETTINGS = (
    "data=folder",
    "data.root=my_rooms",
    "data@photos.data=folder_photos",
    "photos.data.root=my_photos",
    "level=4",
    "network=unet_small",
    "network.widths=[4,8]",
    "data.num_workers=0",
    "photos.data.num_workers=0",
    "trainer.max_epochs=1",
    "trainer.accelerator=cpu",
    "compare=[]",
    "fine_tuning.epochs=[1]",
    "panels=0",
)


def test_classes_scenes_and_cameras_are_compared_before_training(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rooms = write_data_set(tmp_path / "my_rooms", scenes=5)
    photos = write_photos(tmp_path / "my_photos", scenes=5)
    classes = (rooms / "classes.json").read_text()
    for given, told in (
        ({"wall": 1, "window": 255, "floor": 2}, ("window as class 2", "floor")),
        ({"wall": 1, "floor": 2}, ("nothing as class 3", "window")),
    ):
        write_classes(rooms, given)
        message = "stage S: data: found {} in my_rooms/classes.json; expected {}, as in my_photos/"
        with pytest.raises(SystemExit, match=re.escape(message.format(*told))):
            run("transfer", *_SETTINGS)
    assert not Path("runs/transfer/transfer/seed_0").exists()

    (rooms / "classes.json").write_text(classes)
    (rooms / "test.txt").write_text("scene_3/view.0\n")
    (photos / "train.txt").write_text("scene_3/view.0\nscene_4/view.0\n")
    (photos / "val.txt").write_text("scene_2/view.0\n")
    monkeypatch.setattr("tangent_train.cli.transfer.run_stage", lambda *_: 3)
    with pytest.raises(SystemExit) as ended:
        run("transfer", *_SETTINGS)
    assert ended.value.code == 3
    note = "Note: P is trained on photos, and S tested on panoramas, of scene_3. If they show the"
    assert note in capsys.readouterr().out
    write_photo(photos, "scene_1/new.png", 1, film_mm=None)
    message = r"stage P, in photos: my_photos/images/scene_1/new\.png: found no K in cameras\.json"
    with pytest.raises(SystemExit, match=message):
        run("transfer", *_SETTINGS)


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
