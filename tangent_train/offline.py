"""Building networks from files without the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def offline() -> Iterator[None]:
    """Keep huggingface_hub, and all libraries that fetch through it, off the network in a block.

    What the block would fetch is an error of these libraries, unless it is in their local cache.
    """
    try:
        from huggingface_hub import constants
    except ImportError:  # nor is any library that fetches through it
        yield
        return
    hub: Any = constants
    before = hub.HF_HUB_OFFLINE
    hub.HF_HUB_OFFLINE = True  # the value of the environment variable, which is read at import
    try:
        yield
    finally:
        hub.HF_HUB_OFFLINE = before
