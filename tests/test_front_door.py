"""``import tangent_train``: fast, and with the names that people need first."""

from __future__ import annotations

import subprocess
import sys

import pytest

import tangent_train


def test_names_come_from_their_packages() -> None:
    from tangent_train import geometry, rendering

    assert tangent_train.TangentGrid is geometry.TangentGrid
    for name in ("equirect_to_tangent", "tangent_to_equirect", "tangent_to_labels"):
        assert getattr(tangent_train, name) is getattr(rendering, name)
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        _ = tangent_train.missing


def test_importing_the_package_imports_nothing_heavy() -> None:
    code = "import sys, tangent_train; sys.exit(bool({'numpy', 'torch'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
