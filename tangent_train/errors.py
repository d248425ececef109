"""The two errors users meet: a setting that cannot work, a file that cannot be used."""

from __future__ import annotations

__all__ = ["DataError", "SettingError"]


class _ExplainedError(ValueError):
    """An error that says what it is about, what was found, what was expected and the remedy.

    Args:
        subject: The setting, file or folder; alone, the whole message (as when unpickled in
            another process).
        found: What it was.
        expected: What is allowed.
        remedy: What to do about it, one sentence.
    """

    def __init__(
        self, subject: object, *, found: object = None, expected: object = None, remedy: str = ""
    ) -> None:
        message = str(subject)
        if found is not None:
            message = f"{subject}: found {found}; expected {expected}. {remedy}".rstrip()
        super().__init__(message)
        self.found = found


class SettingError(_ExplainedError):
    """A setting that cannot work, named as in the config."""


class DataError(_ExplainedError):
    """A file or folder that cannot be used."""
