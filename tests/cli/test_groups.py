"""Scores of groups of images, against evaluations of these images alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from datamodules.core.loading import gathered_order, share_of_process
from tangent_train.results.evaluation import load_result
from tests.cli.tiny_runs import Run, results
from tests.datamodules.street_format import write_synpass


def test_weathers_and_times_are_rows_of_the_results(run: Run, tmp_path: Path) -> None:
    root = write_synpass(tmp_path / "synpass")
    data = [f"data.root={root}", "data.test_split=val"]
    small = ["level=4", "network=unet_small", "network.widths=[4,8]", "data.num_workers=0"]
    small += ["trainer.max_epochs=1", "trainer.accelerator=cpu", "representation.erp_height=32"]
    run("train", "data=synpass", *data, *small, "hydra.run.dir=whole")
    found = results(tmp_path / "whole")["groups"]
    assert [group["group"] for group in found] == ["day", "fog", "night", "sun"]
    fog = ("data.weather=[fog]", "hydra.run.dir=fog")
    run("evaluate", "checkpoint=whole/checkpoints/last.ckpt", "data=synpass", *data, *fog)
    alone = results(tmp_path / "fog")
    assert found[1]["images"] == alone["images"] == 2
    for name in ("miou", "macc", "miou_solid_angle", "macc_solid_angle"):
        assert found[1][name] == pytest.approx(alone["scores"][name], abs=1e-12)
    assert found[1]["miou"] != found[3]["miou"]
    assert load_result(tmp_path / "whole").groups == found
    table = (tmp_path / "whole" / "results.md").read_text().partition("By group")[2]
    assert f"| fog | 2 | {100 * found[1]['miou']:.1f} |" in table


@pytest.mark.parametrize(("length", "processes"), [(5, 2), (6, 3), (1, 1)])
def test_results_of_processes_are_in_this_order(
    length: int, processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[int] = []
    for rank in range(processes):
        monkeypatch.setattr(
            "datamodules.core.loading.this_process", lambda rank=rank: (rank, processes)
        )
        samples: Any = range(length)
        share: Any = share_of_process(samples)
        order += list(share)
    assert gathered_order(length, processes) == order
