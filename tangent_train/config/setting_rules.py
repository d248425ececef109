"""Rules for settings that may differ when a run is resumed, reported, or shared in a transfer.

The rule of a setting is that of its longest prefix in the table: ``trainer.precision`` has a rule,
and settings below ``trainer`` that are not listed have the rule of ``trainer``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

Purpose = Literal["resume", "report", "transfer", "evaluation"]
"""Relation of two runs: a resumed run and its beginning; runs of one group in a report (folds and
seeds); the same stage of a transfer before and now, if it trains, and if it only evaluates."""

_ALWAYS = "resume report transfer evaluation"
_RULES = (
    # Paths, logging and speed: results do not depend on these.
    (
        _ALWAYS,
        "checkpoint checkpoint_every_n_steps choices logger panels resume trust validation_images",
    ),
    (_ALWAYS, "data.in_memory data.label_table data.num_workers data.root data.store"),
    (_ALWAYS, "task.channels_last task.compile task.eval_view_batch_size"),
    (_ALWAYS, "trainer.accelerator trainer.enable_model_summary trainer.enable_progress_bar"),
    (_ALWAYS, "trainer.log_every_n_steps trainer.num_sanity_val_steps trainer.strategy"),
    ("resume transfer evaluation", "init_from name"),
    # Reports compute means over these.
    ("report", "data.fold data.seed seed"),
    # Settings of the evaluation, which follows the resumed training.
    ("resume", "data.test_rotation task.head.absent_class"),
    ("resume", "task.head.align task.head.alignment task.head.alignment_in task.head.clip"),
    ("resume", "representation.blend representation.levels representation.rotations"),
    # Settings of the training: an evaluation does not depend on these.
    ("evaluation", "callbacks optimizer scheduler task.backbone_lr_factor task.head.loss"),
    ("resume evaluation", "task.view_batch_size trainer.devices trainer.num_nodes"),
    ("resume evaluation", "trainer.max_epochs trainer.max_steps"),
    # A resumed run may be longer, or run on other devices, but takes the same steps.
    ("resume", "trainer"),
    ("", "trainer.accumulate_grad_batches trainer.limit_train_batches trainer.overfit_batches"),
    ("", "trainer.gradient_clip_algorithm trainer.gradient_clip_val"),
    ("", "trainer.precision trainer.sync_batchnorm"),
)
_MAY_DIFFER = {name: purposes.split() for purposes, names in _RULES for name in names.split()}

_TRAINER_SETTINGS = (
    "accelerator barebones callbacks default_root_dir devices enable_autolog_hparams fast_dev_run "
    "inference_mode limit_predict_batches limit_test_batches logger max_time model_registry "
    "num_nodes plugins profiler strategy"
)
OF_THIS_MACHINE = (
    *("callbacks", "logger"),
    *("data.label_table", "data.root", "data.store", "task.compile"),
    *(f"trainer.{name}" for name in _TRAINER_SETTINGS.split()),
)
"""Settings of this machine (paths, processes, logging), which are not taken from a file."""

_OR_PATHS = ("data.mask",)
"""Settings whose value may be a path, which is not taken from a file; numbers are."""


def may_differ(name: str, purpose: Purpose) -> bool:
    """Return True if a setting may differ between two runs.

    Args:
        name: Name of the setting, ``section.setting``.
        purpose: Relation of the two runs.
    """
    while name and name not in _MAY_DIFFER:
        name = name.rpartition(".")[0]
    return purpose in _MAY_DIFFER.get(name, ())


def from_file(name: str, value: Any = None) -> bool:
    """Return True if a setting may be taken from a file.

    Args:
        name: Name of the setting, ``section.setting``.
        value: Value of the setting: a mask may be a latitude, or a path on this machine.
    """
    is_local = any(f"{name}.".startswith(f"{local}.") for local in OF_THIS_MACHINE)
    return not (is_local or _are_paths(name, value))


def flat_settings(config: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield settings of nested sections as ``section.setting``, with their values."""
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flat_settings(value, f"{name}.")
        else:
            yield name, value


def differing_settings(
    now: Mapping[str, Any], before: Mapping[str, Any], purpose: Purpose
) -> list[tuple[str, Any, Any]]:
    """Return settings that differ and must not, with new and old values, sorted by name.

    The value of a missing setting is None.

    Args:
        now: Resolved config of the new run.
        before: Resolved config of the earlier run.
        purpose: Relation of the two runs.
    """
    new, old = dict(flat_settings(now)), dict(flat_settings(before))
    return [
        (name, new.get(name), old.get(name))
        for name in sorted(new.keys() | old.keys())
        if new.get(name) != old.get(name)
        and not may_differ(name, purpose)
        and not (purpose == "resume" and _are_paths(name, new.get(name), old.get(name)))
    ]


def _are_paths(name: str, *values: Any) -> bool:
    return name in _OR_PATHS and all(isinstance(value, str) for value in values)
