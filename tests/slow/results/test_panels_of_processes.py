"""The panels of several processes come together."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from torch import distributed
from torch.multiprocessing.spawn import spawn

from tangent_train.callbacks.panels import PredictionPanels
from tangent_train.results.html import EncodedImage


def _encoded(name: str) -> EncodedImage:
    return EncodedImage(name, "", True, 1, 1, b"jpeg", b"small", None, None, ())


def _gather(rank: int, folder: str) -> None:
    store = f"file://{folder}/store"
    distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=2)
    panels = PredictionPanels(folder)
    panels._encoded = {k: _encoded(str(k)) for k in ((4, 0) if rank == 0 else (7, 2, 9))}
    trainer: Any = SimpleNamespace(world_size=2)
    panels.on_test_end(trainer, trainer)
    (Path(folder) / f"{rank}.txt").write_text(" ".join(image.name for image in panels.images))
    distributed.destroy_process_group()


def test_the_images_of_all_processes_come_together_in_order(tmp_path: Path) -> None:
    spawn(_gather, (str(tmp_path),), nprocs=2)  # type: ignore[no-untyped-call]
    assert [(tmp_path / f"{rank}.txt").read_text() for rank in (0, 1)] == ["0 2 4 7 9"] * 2
