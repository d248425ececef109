"""The same honest run as in `tests.security`."""
