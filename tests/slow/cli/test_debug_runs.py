"""Debug runs, and Lightning's limits, of panoramas, photos and shapes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.cli.tiny_runs import SMALL_ROOMS, Run

_ROOMS = [text for text in SMALL_ROOMS if "batch_size" not in text]
KINDS = {
    "panoramas": ["data=synthrooms", "data.batch_size=2", *_ROOMS],
    "photos": [
        *("data=synthrooms_perspective", "representation=perspective", "data.batch_size=2"),
        *("data.rooms.view_size=32", "data.rooms.views_per_camera=2", *_ROOMS),
    ],
    "shapes": [
        *("experiment=shapes/default", "level=4", "data.batch_size=2"),
        *("data.shapes.train=4", "data.shapes.test=2", "trainer.accelerator=cpu"),
    ],
}


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data of the three kinds, generated once."""
    return tmp_path_factory.mktemp("roots")


@pytest.mark.parametrize("kind", KINDS)
def test_debug_runs_have_results_only_of_whole_tests(
    kind: str,
    roots: Path,
    run: Run,
    plain: tuple[str, ...],
) -> None:
    network = plain if kind != "shapes" else ()
    common = [*network, *KINDS[kind], f"data.root={roots / kind}", "data.num_workers=0"]
    for option, more in {
        "fast": ["+trainer.detect_anomaly=true"],
        "limit": ["trainer.limit_train_batches=2", "trainer.limit_test_batches=1"],
        "overfit": ["trainer.max_epochs=2", "+trainer.limit_predict_batches=1"],
        "profile": ["trainer.check_val_every_n_epoch=1", "logger=none"],
    }.items():
        run("train", *common, f"debug={option}", *more, f"hydra.run.dir={option}")
        assert Path(option, "results.json").is_file() == (option in ("overfit", "profile"))
    content = torch.load("limit/checkpoints/last.ckpt", weights_only=True)
    assert content["global_step"] == 2 * 2, "epochs of 2 batches"
    content = torch.load("overfit/checkpoints/last.ckpt", weights_only=True)
    assert content["global_step"] == 2 * 2, "epochs of 2 batches"
    assert not Path("profile/tensorboard").exists()
    assert json.loads(Path("overfit/results.json").read_text())
