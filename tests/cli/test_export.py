"""`tangent-export` as it is typed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tangent_train.checkpoints.loaded import load_network
from tests.cli.tiny_runs import Run
from tests.tasks.small_networks import save_checkpoint


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "best.ckpt"
    save_checkpoint(path, "network.widths=[4,8]")
    return path


@pytest.mark.parametrize("name", ["a.onnx", "new/folder/model.SAFETENSORS"])
def test_the_suffix_selects_the_format(
    name: str, checkpoint: Path, tmp_path: Path, run: Run, capfd: pytest.CaptureFixture[str]
) -> None:
    run("export", f"checkpoint={checkpoint}", f"output={name}")
    printed, errors = capfd.readouterr()
    assert errors == ""
    path = tmp_path / name
    assert "images: 4 channels, any size, multiples of 2; scores: 13 classes\n" in printed
    assert load_network(path).in_channels == 4
    kept = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert kept == [path]  # and no folder of Hydra's


def test_export_errors_are_one_line(checkpoint: Path, tmp_path: Path, run: Run) -> None:
    message = r"^tangent-export: image_size: found \(9, 9\); expected multiples of 2"
    with pytest.raises(SystemExit, match=message):
        run("export", f"checkpoint={checkpoint}", "output=x.safetensors", "image_size=[9,9]")
    assert list(tmp_path.iterdir()) == []
