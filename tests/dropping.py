"""A network of a user's own, with dropout, which draws from torch's generator at every step."""

from __future__ import annotations

from pathlib import Path

TRUST = "trust=dropping.Dropping"
"""The setting with which a run of it is resumed."""

_MODULE = """
from torch import nn


class Dropping(nn.Conv2d):
    def forward(self, images):
        return nn.functional.dropout2d(super().forward(images), training=self.training)
"""
_CONFIG = """
_target_: dropping.Dropping
in_channels: 4
out_channels: 13
kernel_size: 3
padding: 1
"""


def write_dropout(folder: Path) -> None:
    """Write it as ``network=dropout``, in a module of this folder: to be on the path of Python."""
    (folder / "network").mkdir(parents=True, exist_ok=True)
    (folder / "network" / "dropout.yaml").write_text(_CONFIG)
    (folder / "dropping.py").write_text(_MODULE)
