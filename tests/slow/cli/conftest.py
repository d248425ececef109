"""The same finished run as in `tests.cli`, and a network without batch statistics."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import rooms, run, run_folder, stages  # noqa: F401 - fixtures

_PLAIN = """
_target_: torch.nn.Conv2d
in_channels: 4
out_channels: 13
kernel_size: 3
padding: 1
"""


@pytest.fixture
def plain(tmp_path: Path) -> tuple[str, ...]:
    """Arguments that choose a network of one convolution, to be the first ones."""
    (tmp_path / "own" / "network").mkdir(parents=True)
    (tmp_path / "own" / "network" / "plain.yaml").write_text(_PLAIN)
    return ("--config-dir=own", "network=plain")
