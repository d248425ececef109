"""The same finished run as in `tests.cli`."""
