"""The same honest run as in `tests.security`."""

from tests.security.conftest import content, forbidden, run  # noqa: F401 - fixtures
