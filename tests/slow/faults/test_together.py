"""Several processes that prepare and read the same files at the same time."""

from __future__ import annotations

import multiprocessing
import zlib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.rendering import TangentRepresentation

PROCESSES = 3
PANORAMAS = 14


def _data(root: Path, store: Path | None) -> Stanford2D3DS:
    representation = TangentRepresentation(base_level=0, level=4)
    return Stanford2D3DS(root, representation, store=store, batch_size=1)


def _samples(data: Stanford2D3DS) -> int:
    """A checksum of all that a training and a test see."""
    checksum = 0
    for batch in (*data.train_dataloader(), *data.test_dataloader()):
        for part in batch:
            for tensor in part if isinstance(part, list) else [part]:
                checksum = zlib.crc32(tensor.contiguous().numpy().tobytes(), checksum)
    return checksum


def _prepare_and_read(root: Path, store: Path, barrier: Any) -> tuple[int, int]:
    torch.set_num_threads(1)
    data = _data(root, store)
    barrier.wait()
    data.prepare_data()
    return len(list(store.rglob("[!.]*.npy"))), _samples(data)


def test_runs_that_prepare_the_same_store_at_once_see_the_same(
    stanford_root: Path, tmp_path: Path
) -> None:
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["datamodules.stanford2d3ds.panoramas"])
    store = tmp_path / "store"
    with processes.Manager() as manager, ProcessPoolExecutor(PROCESSES, processes) as pool:
        barrier = manager.Barrier(PROCESSES)
        runs = [
            pool.submit(_prepare_and_read, stanford_root, store, barrier) for _ in range(PROCESSES)
        ]
        found = [run.result() for run in runs]
    assert found == [(PANORAMAS, _samples(_data(stanford_root, None)))] * PROCESSES
    assert not list(store.rglob(".partial*"))
    data = _data(stanford_root, store)
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*.npy")}
    data.prepare_data()
    assert {path: path.stat().st_mtime_ns for path in before} == before, "all are whole"
