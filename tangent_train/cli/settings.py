"""Checks of settings that several commands share."""

from __future__ import annotations

from typing import Any

from tangent_train.errors import SettingError


def check_unread(settings: Any, reason: str, **unread: Any) -> None:
    """Refuse settings that nothing would read.

    Args:
        settings: Settings of a command.
        reason: Reason that nothing reads them, after their value: "for photos".
        **unread: Value of each setting when it is not used.

    Raises:
        SettingError: A setting has another value.
    """
    for name, unused in unread.items():
        if (found := getattr(settings, name)) != unused:
            expected = f"{'null' if unused is None else unused} {reason}"
            raise SettingError(name, found=found, expected=expected)
