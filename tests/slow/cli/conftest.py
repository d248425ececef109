"""The same finished run as in `tests.cli`."""

from tests.cli.conftest import rooms, run, run_folder

__all__ = ["rooms", "run", "run_folder"]
