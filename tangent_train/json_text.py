"""JSON from untrusted files."""

from __future__ import annotations

import json
from typing import Any

__all__ = ["parse_json"]


def parse_json(text: str | bytes, **options: Any) -> Any:
    """`json.loads`, with a `ValueError` for text that is nested too deeply.

    Args:
        text: UTF-8, UTF-16 or UTF-32 where it is bytes.
        **options: For `json.loads`.

    Raises:
        ValueError: It is no JSON.
    """
    try:
        return json.loads(text, **options)
    except RecursionError as error:
        raise ValueError("its brackets are nested too deeply") from error
