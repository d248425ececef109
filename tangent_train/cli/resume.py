"""What may change when a run is resumed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tangent_train.errors import SettingError
from tangent_train.tasks.runs import flat_settings

__all__ = ["check_resumed"]

_FREE = (
    "checkpoint_every_n_steps",
    "data.in_memory",
    "data.label_table",
    "data.num_workers",
    "data.root",
    "data.store",
    "data.test_rotation",
    "name",
    "panels",
    "resume",
    "task.absent_class",
    "task.channels_last",
    "task.compile",
    "task.images_per_chunk",
    "task.images_per_forward",
    "trainer",
)
"""Settings, with all below them, that say where and how a run is computed, not what."""

_NOT_FREE = tuple(
    f"trainer.{name}"
    for name in (
        "accumulate_grad_batches",
        "gradient_clip_algorithm",
        "gradient_clip_val",
        "limit_train_batches",
        "overfit_batches",
        "precision",
        "sync_batchnorm",
    )
)
"""Except these."""

_REASONS = {
    "network": "the checkpoint holds the tensors of its own network",
    "data": "it would be another training set",
    "representation": "it would be another training set",
    "seed": "order and faces would be others",
    "optimizer": "its state and learning rate come from the checkpoint",
    "scheduler": "its state comes from the checkpoint",
    "task": "it would be another loss",
    "trainer": "it would take other steps",
}


def check_resumed(config: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Refuse to resume a run as another one.

    Args:
        config: The resolved config.
        before: The resolved config in the checkpoint.

    Raises:
        SettingError: A setting differs that makes the run what it is.
    """
    now, then = dict(flat_settings(config)), dict(flat_settings(before))
    for name in sorted(now.keys() | then.keys()):
        free = any(name == free or name.startswith(f"{free}.") for free in _FREE)
        if (free and name not in _NOT_FREE) or now.get(name) == then.get(name):
            continue
        reason = _REASONS.get(name.partition(".")[0], "it would be another run")
        raise SettingError(
            name,
            found=f"{now.get(name)!r} for a run that began with {then.get(name)!r}",
            expected=f"no other than before: {reason}",
            remedy="Start a new run for it.",
        )
