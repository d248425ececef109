"""What may change when a run is resumed."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from tangent_train.checkpoints.content import flat_settings
from tangent_train.errors import SettingError

__all__ = ["check_resumed", "differing_settings"]

_FREE = (
    "checkpoint",
    "checkpoint_every_n_steps",
    "choices",
    "data.in_memory",
    "data.label_table",
    "data.num_workers",
    "data.root",
    "data.store",
    "data.test_rotation",
    "init_from",
    "name",
    "panels",
    "representation.average_rotations",
    "resume",
    "task.absent_class",
    "task.channels_last",
    "task.compile",
    "task.images_per_chunk",
    "task.images_per_forward",
    "tensorboard_images",
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
    for name, now, then in differing_settings(config, before, _FREE, but=_NOT_FREE):
        reason = _REASONS.get(name.partition(".")[0], "it would be another run")
        raise SettingError(
            name,
            found=f"{now!r} for a run that began with {then!r}",
            expected=f"no other than before: {reason}",
            remedy="Start a new run for it.",
        )


def differing_settings(
    config: Mapping[str, Any],
    before: Mapping[str, Any],
    free: Collection[str],
    but: Collection[str] = (),
) -> list[tuple[str, Any, Any]]:
    """Settings that differ, sorted by name, with what they are and what they were.

    A setting that one of the two does not have is None there.

    Args:
        config: A resolved config.
        before: Another one.
        free: Settings, with all below them, that may differ.
        but: Except these.
    """
    now, then = dict(flat_settings(config)), dict(flat_settings(before))
    return [
        (name, now.get(name), then.get(name))
        for name in sorted(now.keys() | then.keys())
        if now.get(name) != then.get(name)
        and (name in but or not any(name == f or name.startswith(f"{f}.") for f in free))
    ]
