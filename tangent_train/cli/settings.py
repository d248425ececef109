"""Checks of settings that several commands share."""

from __future__ import annotations

from pathlib import Path
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


def check_new(settings: Any, *outputs: Path | None) -> None:
    """Refuse to replace existing files and folders unless `settings.overwrite` is True.

    Empty folders may be used.

    Raises:
        SettingError: A file, or a folder with content, exists.
    """
    for path in () if settings.overwrite else filter(None, outputs):
        if any(path.iterdir()) if path.is_dir() else path.exists():
            raise SettingError(
                "output",
                found=f"{path}, which exists",
                expected="a path that does not exist yet",
                remedy="Give another output, or overwrite=true.",
            )
