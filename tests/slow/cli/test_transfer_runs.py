"""``tangent-transfer`` with real runs, small ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from tests.cli.pretended_runs import HERE, OF_SEED_0, SETTINGS
from tests.cli.tiny_runs import run_command


def test_real_runs_from_photos_to_panoramas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my" / "network").mkdir(parents=True)
    (tmp_path / "my" / "network" / "plain.yaml").write_text(
        "_target_: torch.nn.Conv2d\nin_channels: 4\nout_channels: 13\nkernel_size: 1\n"
    )
    network = (*SETTINGS, "network=plain", "compare=[]", "trainer.max_epochs=2", "--config-dir=my")
    run_command(monkeypatch, "transfer", *network)
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
    run_command(monkeypatch, "transfer", *network)
    out = capsys.readouterr().out
    assert out.count("finished before") == 2
    assert (HERE / "transfer.csv").read_text() == before, "the same figures again"
    left = {path.name for path in tmp_path.iterdir() if path.name[0] != "."}  # those are coverage's
    assert left == {"data", "my", "runs"}
