"""The two user errors: an invalid setting, and an unusable file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from itertools import takewhile
from numbers import Integral
from typing import Any

_LONGEST = 400
"""Largest number of characters of the value found, which may come from a file."""

_CONTROL = re.compile(r"[^\n\t -~\xa0-\U0010ffff]")
"""Characters that terminals interpret as commands."""


_UNKNOWN = "a known setting"
_EXPECTED = {
    "extra_forbidden": _UNKNOWN,
    "unexpected_keyword_argument": _UNKNOWN,
    "path_not_file": "an existing file",
    "path_not_directory": "an existing folder",
}
"""Texts for errors of pydantic whose messages name no value."""


def printable(text: str) -> str:
    r"""Escape terminal control sequences in lines of text.

    >>> print(printable("sofa\x1b[2J"))
    sofa\x1b[2J
    """
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], text)


def counted(count: int, plural: str) -> str:
    """Return a number with its noun, whose plural ends in s.

    >>> counted(1, "panoramas"), counted(20, "photos")
    ('1 panorama', '20 photos')
    """
    return f"{count} {plural.removesuffix('s') if count == 1 else plural}"


def first_line(error: object) -> str:
    """Return the first line of an error's message: messages of other libraries may be long."""
    return str(error).strip().partition("\n")[0]


def width_height(size: Sequence[float]) -> str:
    """Return the size of an image as text.

    Args:
        size: Rows and columns of the image.

    >>> width_height((1024, 2048))
    '2048 × 1024 (width × height)'
    """
    return f"{size[1]:.10g} × {size[0]:.10g} (width × height)"


class _ExplainedError(ValueError):
    """An error with its subject, the value found, the values expected and the remedy.

    Args:
        subject: Setting, file or folder. Without `found`, it is the whole message, e.g. when the
            error is unpickled in another process.
        found: Value found.
        expected: Allowed values.
        remedy: Remedy, one sentence.
    """

    def __init__(
        self, subject: object, *, found: object = None, expected: object = None, remedy: str = ""
    ) -> None:
        message = finding = str(subject)
        if found is not None:
            # For an OSError, only its reason: the path is the subject.
            shown = getattr(found, "strerror", None) or str(found)
            shown = shown if len(shown) <= _LONGEST else shown[:_LONGEST] + "…"
            finding = f"{shown}; expected {expected}"
            message = f"{subject}: found {finding}. {remedy}".rstrip()
        super().__init__(printable(message))
        self.finding = printable(finding)
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy


class SettingError(_ExplainedError):
    """An invalid setting, named as in the config."""


class DataError(_ExplainedError):
    """A file or folder that cannot be used."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a remedy that names the most similar of the known names, or nothing.

    >>> nearest("levl", ["level", "seed"])
    'Did you mean level?'
    """
    return "".join(f"Did you mean {similar}?" for similar in get_close_matches(name, known, 1))


def wrong_setting(error: Any, known: Mapping[str, str], prefix: str = "") -> SettingError:
    """Return the first error of a validation; errors of a setting's alternatives are joined.

    Args:
        error: pydantic's ValidationError.
        known: Comments of the known settings by name.
        prefix: Prefix of the setting's name in the message.
    """
    first = error.errors()[0]
    same = [one for one in error.errors() if one["loc"][:1] == first["loc"][:1]]
    parts = zip(*(one["loc"] for one in same), strict=False)
    common = takewhile(lambda part: len({*part}) == 1 and isinstance(part[0], str), parts)
    name = ".".join(part[0] for part in common)
    if first["type"].startswith("missing"):
        return SettingError(prefix + name, found="nothing", expected=known.get(name, "a value"))
    texts = (_EXPECTED.get(one["type"]) or one.get("ctx", {}).get("error") for one in same)
    messages = (re.sub("^Input should be |, unable to .*", "", one["msg"]) for one in same)
    expected = dict.fromkeys(str(text or m) for text, m in zip(texts, messages, strict=True))
    return SettingError(
        prefix + name,
        found="null" if first["input"] is None else first["input"],
        expected=" or ".join(expected),
        remedy=nearest(name, known) if _UNKNOWN in expected else "",
    )


def wrong_field(error: Any) -> str:
    """Return the first error of a validation of a file's content, for a message."""
    wrong = wrong_setting(error, {})
    return f"{wrong.subject}={wrong.found}, not {wrong.expected}"


def at_least(name: str, value: object, least: int) -> int:
    """Return a setting that has to be an integer, also of NumPy, not less than `least`.

    Raises:
        SettingError: The value is not such an integer.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise SettingError(name, found=value, expected=f"an integer of {least} or more")
    return int(value)


def check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise SettingError unless a value is one of those allowed."""
    if value not in allowed:
        raise SettingError(name, found=repr(value), expected=" or ".join(map(repr, allowed)))


@contextmanager
def of_extra(extra: str, subject: object, remedy: str = "") -> Iterator[None]:
    """Explain a missing package in a block that imports packages of an extra of tangent-train.

    Args:
        extra: Name of the extra.
        subject: Setting or file that needs these packages.
        remedy: Further remedy.

    Raises:
        SettingError: A package is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise SettingError(
            subject,
            found=f"a missing package ({error})",
            expected=f"the packages of the extra {extra}",
            remedy=f"Run in the checkout: pip install -e '.[{extra}]'. {remedy}".rstrip(),
        ) from error
