"""``tangent-transfer`` with real runs, small ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from tests.cli.pretended_runs import HERE, OF_SEED_0, SETTINGS
from tests.cli.tiny_runs import Run
from tests.datamodules.folder.folder_format import write_classes, write_data_set
from tests.datamodules.folder.photo_format import write_photos


def test_real_runs_from_photos_to_panoramas(
    tmp_path: Path, run: Run, plain: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    network = (*plain, *SETTINGS, "compare=[]", "trainer.max_epochs=2")
    run("transfer", *network)
    stages = ["P", "S", "P-FT-1", "S-FT-1"]
    found = {name: json.loads((OF_SEED_0 / name / "results.json").read_text()) for name in stages}
    assert [found[name]["images"] for name in stages] == [4, 2, 4, 2], "photos, panoramas"
    assert found["S"]["confusion"] != found["S-FT-1"]["confusion"]
    p, tuned = (
        torch.load(OF_SEED_0 / name / "checkpoints" / "last.ckpt", weights_only=True)
        for name in ("P", "S-FT-1")
    )
    assert found["S-FT-1"]["settings"]["optimizer.lr"] == 3e-4
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
    assert left == {"data", "own", "runs"}


_SETTINGS = (
    "data=folder",
    "data.root=my_rooms",
    "data@photos.data=folder_photos",
    "photos.data.root=my_photos",
    "level=4",
    "network=unet_small",
    "network.widths=[4,8]",
    "compare=[]",
)


def test_classes_are_compared_before_training(tmp_path: Path, run: Run) -> None:
    rooms = write_data_set(tmp_path / "my_rooms", scenes=5)
    write_photos(tmp_path / "my_photos", scenes=5)
    write_classes(rooms, {"wall": 1, "window": 255, "floor": 2})
    message = r"data: found classes .*'window', 'floor'.*; expected the same of both"
    with pytest.raises(SystemExit, match=message):
        run("transfer", *_SETTINGS)
    assert not list(Path("runs").rglob("P"))
