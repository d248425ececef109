"""The same honest run as in `tests.security`."""

from tests.security.conftest import content, forbidden, run

__all__ = ["content", "forbidden", "run"]
