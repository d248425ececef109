"""The same finished run as in `tests.cli`."""

from tests.cli.conftest import rooms, run, run_folder  # noqa: F401 - fixtures
