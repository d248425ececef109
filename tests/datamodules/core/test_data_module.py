from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import LambdaCallback
from lightning.pytorch.plugins import HalfPrecision
from lightning.pytorch.trainer.states import TrainerFn
from numpy.typing import NDArray

from datamodules.core.dataset import Image
from datamodules.core.files import SPLITS, ImageFiles
from datamodules.core.label_map import class_weights
from datamodules.core.loading import EpochSampler
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.rendering import TangentRepresentation
from tests.conftest import fabricate
from tests.datamodules.data_files import names_of

MakeModule = Callable[..., Stanford2D3DS]


@pytest.fixture
def make_module(stanford_root: Path, erp: Any) -> MakeModule:
    def make(**settings: Any) -> Stanford2D3DS:
        return Stanford2D3DS(stanford_root, erp, **settings)

    return make


# --- loaders -----------------------------------------------------------------------------------


@pytest.mark.parametrize("in_memory", [False, True])
def test_the_same_samples_for_any_number_of_workers(
    make_module: MakeModule, in_memory: bool
) -> None:
    def two_epochs(num_workers: int) -> list[list[bytes]]:
        loader = make_module(num_workers=num_workers, in_memory=in_memory).train_dataloader()
        epochs = []
        for epoch in (0, 1):
            loader.sampler.set_epoch(epoch)  # type: ignore[attr-defined]
            tensors = [t for batch in loader for t in (batch.index, batch.labels, *batch.images)]
            epochs.append([tensor.numpy().tobytes() for tensor in tensors])
        return epochs

    alone = two_epochs(0)
    assert two_epochs(2) == alone  # persistent workers learn about the new epoch, too
    assert alone[0] != alone[1]


def test_rotated_panoramas_are_seen_upright_where_up_is_known(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    rotated, known = make_module(test_rotation=30), make_module(test_rotation=30, upright="pose")
    panorama, aware = rotated.dataset("test").read(0), known.dataset("test").read(0)
    np.testing.assert_array_equal(panorama.rgb, aware.rgb)
    np.testing.assert_array_equal(panorama.labels, aware.labels)
    assert panorama.up is None
    assert aware.up is not None
    assert np.degrees(np.arccos(aware.up[2])) == pytest.approx(30)
    representation = TangentRepresentation(0, 3)
    rotation = aware.sampler(representation).grid.rotation
    np.testing.assert_allclose(rotation @ [0, 0, 1], aware.up, atol=1e-12)
    for split in ("train", "val"):
        assert known.dataset(split).read(0).up is None
    tagged = np.array([0.6, 0, 0.8])
    monkeypatch.setattr("datamodules.core.image_module.read_up", lambda path: tagged)
    known = make_module(test_rotation=30, upright="pose")
    np.testing.assert_array_equal(known.dataset("train").read(0).up, tagged)
    rotated_up = known.dataset("test").read(0).up
    assert rotated_up is not None
    assert aware.up @ rotated_up == pytest.approx(0.8)


def test_a_network_estimates_up_of_test_panoramas_that_were_read_before(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    def estimate(rgb: NDArray[np.uint8], max_tilt_deg: float, judge: Any) -> Any:
        return None if judge is None else np.eye(3)[judge(np.eye(3)).argmax()]

    def judge(panorama: Any, ups: NDArray[np.float64]) -> NDArray[np.float64]:
        return ups[:, 1]

    monkeypatch.setattr("datamodules.core.image_module.estimate_up", estimate)
    auto, upright = make_module(upright="auto"), make_module()
    assert auto.dataset("test").read(0).up is None
    for module in (auto, upright):
        module.estimate_up(judge)
        module.test_dataloader()
    assert auto.dataset("test").read(0).up.tolist() == [0, 1, 0]
    assert auto.dataset("val").read(0).up is None
    assert upright.dataset("test").read(0).up is None


def test_processes_share_the_panoramas(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 3)
    seen, steps = [], set()
    for rank in range(3):
        monkeypatch.setattr("torch.distributed.get_rank", lambda rank=rank: rank)
        module = make_module()
        seen += [int(batch.index) for batch in module.test_dataloader()]
        steps.add(len(module.train_dataloader()))
    assert sorted(seen) == list(range(5))
    assert len(steps) == 1


def test_processes_take_the_files_of_the_first_which_has_read_everything_once(
    tmp_path: Path, erp: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = fabricate(tmp_path)
    broken = next((root / "area_1/pano/rgb").iterdir())
    content = broken.read_bytes()
    broken.write_bytes(content[:200] + bytes(20) + content[220:])
    read: list[str] = []
    decode = Stanford2D3DS.decode

    def counted(self: Stanford2D3DS, files: ImageFiles) -> Image:
        read.append(files.name)
        return decode(self, files)

    monkeypatch.setattr(Stanford2D3DS, "decode", counted)
    sent: list[bytes] = []  # as to another process

    def broadcast(splits: Any) -> Any:
        sent.extend([pickle.dumps(splits)] if splits is not None else [])
        return pickle.loads(sent[0])

    names = []
    for rank in range(2):
        module = Stanford2D3DS(root, erp, skip_broken=True, val_fraction=0)
        for stage in ("fit", "test"):
            state = SimpleNamespace(fn=TrainerFn.FITTING if stage == "fit" else TrainerFn.TESTING)
            strategy = SimpleNamespace(broadcast=broadcast)
            module.trainer = SimpleNamespace(  # type: ignore[assignment]
                strategy=strategy, state=state, world_size=2
            )
            if rank == 0:
                module.prepare_data()
            module.setup(stage)
        names.append([names_of(module, split) for split in SPLITS])
    assert names[0] == names[1]
    assert sorted(map(len, names[1])) == [0, 5, 8]
    assert len(read) == len(set(read)) == 14


def test_a_module_can_be_sent_to_another_process(make_module: MakeModule) -> None:
    module = make_module()
    module.trainer = SimpleNamespace(fit_loop=lambda: None)  # type: ignore[assignment]
    sample = pickle.loads(pickle.dumps(module.dataset("train")))[1, 0]
    assert torch.equal(sample.labels, module.dataset("train")[1, 0].labels)


@pytest.mark.filterwarnings("ignore:.*your dataloader is not resumable")
def test_overfitting_takes_the_same_views_in_every_epoch_of_both_splits(
    make_module: MakeModule, tmp_path: Path
) -> None:
    class Seen(LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(()))
            self.batches: dict[str, list[tuple[int, float]]] = {"train": [], "val": []}

        def training_step(self, batch: Any, number: int) -> Any:
            self.batches["train"].append((int(batch.index), float(batch.images.sum())))
            return self.weight * 1

        def validation_step(self, batch: Any, number: int) -> None:
            self.batches["val"].append((int(batch.index), float(batch.images.sum())))

        def configure_optimizers(self) -> Any:
            return torch.optim.SGD(self.parameters(), 1)

    quiet: dict[str, Any] = {
        "accelerator": "cpu",
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "use_distributed_sampler": False,
        "num_sanity_val_steps": 0,
    }
    task, module = Seen(), make_module(batch_size=1)

    def save(trainer: Trainer, *_: Any) -> None:
        if trainer.global_step == 1:
            trainer.save_checkpoint(tmp_path / "within.ckpt")

    saved = LambdaCallback(on_train_batch_end=save)
    Trainer(max_epochs=2, overfit_batches=2, callbacks=saved, **quiet).fit(task, datamodule=module)
    first, second, *again = task.batches["train"]
    assert again == [first, second]
    assert [index for index, _ in (first, second)] == [0, 1]
    assert task.batches["val"][:1] == task.batches["val"][-1:]
    resumed, trainer = Seen(), Trainer(max_epochs=2, overfit_batches=2, **quiet)
    path = tmp_path / "within.ckpt"
    trainer.fit(resumed, datamodule=make_module(batch_size=1), ckpt_path=path)
    assert resumed.batches["train"] == [second, first, second]


def test_images_have_the_precision_of_the_run(
    make_module: MakeModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = make_module()
    batch = next(iter(module.test_dataloader()))
    run = SimpleNamespace(precision_plugin=HalfPrecision("bf16-true"))
    monkeypatch.setattr(module, "trainer", run)
    assert module.on_after_batch_transfer(batch, 0).images.dtype == torch.bfloat16


COUNTS = np.array([4_000_000, 1_000_000, 900_000, 50_000, 0, 300])


def test_weights_are_those_of_the_formulas() -> None:
    shares = COUNTS[COUNTS > 0] / 5_950_300
    root = shares**-0.5
    for kind, expected in (("log", 1 / np.log(1.02 + shares)), ("sqrt", root / root.mean())):
        weights = class_weights(COUNTS, kind)  # type: ignore[arg-type]
        np.testing.assert_allclose(weights, np.insert(expected, 4, 0), rtol=1e-6)
        assert weights.dtype == np.float32


def _indices(sampler: EpochSampler) -> list[int]:
    return [index for _, index in sampler]


def test_shuffled_order_is_new_every_epoch_and_reproducible() -> None:
    sampler, again = EpochSampler(20, 7), EpochSampler(20, 7)
    first = _indices(sampler)
    sampler.set_epoch(3)
    again.set_epoch(3)
    assert list(sampler) == list(again)
    assert {epoch for epoch, _ in sampler} == {3}
    assert sorted(first) == sorted(_indices(sampler)) == list(range(20))
    assert first != _indices(sampler) != list(range(20))
    assert _indices(EpochSampler(20, 8)) != first


def test_a_resumed_epoch_goes_on_behind_what_was_had() -> None:
    whole, resumed = EpochSampler(9, 3, 1, 2), EpochSampler(9, 3, 1, 2, start=(4, 3))
    for epoch in (4, 5):
        whole.set_epoch(epoch)
        if epoch > 4:  # the first time its epoch is known from the start
            resumed.set_epoch(epoch)
        assert list(resumed) == list(whole)[3 if epoch == 4 else 0 :]
        assert len(resumed) == len(whole) == 4
