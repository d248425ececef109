"""From an imported photo network to a fine-tuned one in other programs' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from tests.cli.imported import write_imported
from tests.cli.test_commands import CUT_SHORT
from tests.cli.tiny_runs import SETTINGS, results, run_command, run_in
from tests.running import run_python

TYPED = [text for text in SETTINGS if "network" not in text]
TUNED = (
    "task.frozen=[stem,downs.0]",
    "optimizer.backbone_lr_factor=0.1",
    "data.inputs=[rgb]",
    "init_from=net.ckpt",
)


@pytest.fixture(scope="module")
def tuned(rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run that was fine-tuned, ``whole``; the imported network is gone."""
    folder = tmp_path_factory.mktemp("tuned")
    write_imported(folder / "net.ckpt")
    (folder / "cut_short.py").write_text(CUT_SHORT)
    cut = run_python(folder, "cut_short.py", *TYPED, *TUNED, rooms, "hydra.run.dir=cut")
    assert "all up to here; resume with" in cut.stderr, cut.stderr
    run_in(folder, "train", *TYPED, *TUNED, rooms, "hydra.run.dir=whole")
    (folder / "net.ckpt").unlink()
    return folder


def _last(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    return content


def test_it_is_resumed_exactly_without_the_imported_file(
    tuned: Path, rooms: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tuned)
    before = _last(tuned / "cut")
    assert before["global_step"] == 2
    run_command(monkeypatch, "train", "resume=cut", rooms, "trainer.accelerator=cpu")
    found, expected = _last(tuned / "cut"), _last(tuned / "whole")
    torch.testing.assert_close(found["state_dict"], expected["state_dict"], rtol=0, atol=0)
    now, then = (content["optimizer_states"][0] for content in (found, expected))
    torch.testing.assert_close(now["state"], then["state"], rtol=0, atol=0)
    assert now["param_groups"] == then["param_groups"]
    for part in ("lr_schedulers", "fresh"):
        assert found[part] == expected[part]
    assert results(tuned / "cut") == results(tuned / "whole")
    groups = expected["optimizer_states"][0]["param_groups"]
    assert [group["name"] for group in groups] == ["backbone", "new"]
    assert groups[0]["lr"] == pytest.approx(groups[1]["lr"] / 10)
    frozen = [name for name in before["state_dict"] if ".stem." in name or ".downs.0." in name]
    assert len(frozen) > 10
    for name in frozen:
        assert torch.equal(before["state_dict"][name], expected["state_dict"][name]), name
