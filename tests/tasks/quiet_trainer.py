"""A trainer that writes and says nothing."""

from __future__ import annotations

from typing import Any

import lightning


def quiet_trainer(**settings: Any) -> lightning.Trainer:
    """On the CPU; `settings` come before its own."""
    quiet: dict[str, Any] = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "accelerator": "cpu",
        "num_sanity_val_steps": 0,
    }
    return lightning.Trainer(**(quiet | settings))
