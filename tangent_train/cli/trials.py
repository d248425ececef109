"""Try a training on empty inputs, before data is generated."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import nn
from torch.optim.lr_scheduler import ReduceLROnPlateau

from tangent_train.errors import SettingError, counted

_RGB = 3


def try_training(task: Any, data: Any, settings: Mapping[str, Any]) -> None:
    """Try a training step of full size, the optimizer and the scheduler.

    The data module tries the last step of an epoch once it has counted its samples.

    Args:
        task: Task of the run.
        data: Data module of the run.
        settings: Settings of the run.

    Raises:
        SettingError: The run cannot be trained.
    """
    synchronized = bool(settings["trainer"].get("sync_batchnorm"))
    data.try_step = partial(_try_step, copy.deepcopy(task).to("meta"), data, synchronized)
    data.try_step(data.batch_size)
    _try_schedule(task, settings)


def _try_schedule(task: Any, settings: Mapping[str, Any]) -> None:
    """Build the optimizer and the scheduler, and take a step."""
    group = {"params": [torch.zeros(1, 1, requires_grad=True)]}

    def schedule() -> None:
        built = task.optimization(lambda: {"epoch": 1000, "step": 1000})
        if isinstance(built, dict):
            built["optimizer"].step(lambda: 0.0)  # some optimizers need a closure
            scheduler = built["lr_scheduler"]["scheduler"]
            scheduler.step(*[0.0] * isinstance(scheduler, ReduceLROnPlateau))

    trials: dict[str, Callable[[], object]] = {
        "optimizer": lambda: task.make_optimizer([group]),
        "scheduler": schedule,
    }
    for name, trial in trials.items():
        try:
            trial()
        except SettingError:
            raise
        except Exception as error:
            expected = f"settings that {settings[name]['_target_']} accepts"
            raise SettingError(
                name, found=f"{type(error).__name__}: {error}", expected=expected
            ) from error


def try_network(task: Any, channels: int) -> None:
    """Run the network on an empty input of the run's size and channels.

    Raises:
        SettingError: The network does not accept it.
    """
    shape = tuple(task.example(channels).shape)
    if fault := find_fault(task, shape, trains=False):
        raise SettingError(
            "network",
            found=f"{type(task.network).__name__}, which does not take {shape} ({fault})",
            expected=f"a network that maps {task.takes}",
            remedy="For a network for photos: data.inputs=[rgb]." if channels > _RGB else "",
        )


def _try_step(probe: Any, data: Any, synchronized: bool, samples: int) -> None:
    """Run the network in training mode on the smallest chunk of a training step.

    Batch normalization fails on a single value per channel, e.g. one image with 1 × 1 features.

    Args:
        probe: Copy of the task on the device ``meta``.
        data: Data module of the run.
        synchronized: True if batch normalization uses the images of all processes.
        samples: Number of panoramas, photos or shapes in the step.

    Raises:
        SettingError: The network cannot be trained on the chunk.
    """
    if synchronized and (data.trainer is None or data.trainer.world_size > 1):
        return
    step = probe.empty_step(data.in_channels, samples)
    chunk = min(probe.chunks(step), key=len)
    shape = tuple(chunk.shape)
    if fault := find_fault(probe.network, shape, trains=True):
        per_step = "data.batch_size"
        is_whole = len(chunk) == len(step)
        raise SettingError(
            per_step if is_whole else "task.view_batch_size",
            found=f"{data.batch_size if is_whole else probe.view_batch_size}, so that in a step of "
            f"{counted(samples, data.noun)} {type(probe.network).__name__} gets {shape}, on which "
            f"it cannot be trained ({fault})",
            expected="more images at a time, including the last step of an epoch",
            remedy=f"Change {per_step} or task.view_batch_size, or choose a network without batch "
            "normalization.",
        )


def find_fault(module: nn.Module, shape: tuple[int, ...], *, trains: bool) -> str | None:
    """Return the first line of a module's error on empty images; None without an error.

    Nothing is computed if the device ``meta``, which has only shapes, raises no error.
    """
    fault = None
    for device in ("meta", "cpu"):
        trial = copy.deepcopy(module).to_empty(device=device).train(trains)
        try:
            with torch.random.fork_rng(devices=[]), torch.no_grad():
                for tensor in (*trial.parameters(), *trial.buffers()):
                    tensor.zero_()  # uninitialized memory may hold invalid indices in buffers
                trial.forward(torch.zeros(shape, device=device))  # does not compile
        except SettingError:
            raise
        except (RuntimeError, ValueError) as error:
            fault = str(error).partition("\n")[0]
        else:
            return None
    return fault
