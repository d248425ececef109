"""``import tangent_train``: fast, and with the names that people need first."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import tangent_train
from tests.running import run_python


def test_names_come_from_their_packages() -> None:
    from tangent_train import geometry, rendering
    from tangent_train.inference import api

    assert tangent_train.TangentGrid is geometry.TangentGrid
    assert tangent_train.load is api.load
    assert tangent_train.apply is api.apply
    for name in ("equirect_to_tangent", "tangent_to_equirect", "tangent_to_labels"):
        assert getattr(tangent_train, name) is getattr(rendering, name)
    assert set(tangent_train.__all__) <= set(dir(tangent_train))
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        _ = tangent_train.missing


def test_importing_the_package_imports_nothing_heavy() -> None:
    """Nor does listing its names, as notebooks do to complete them."""
    code = """if True:
        import sys, tangent_train
        dir(tangent_train)
        sys.exit(bool({'numpy', 'torch'} & set(sys.modules)))
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_modules_of_our_names_that_come_first_are_named(tmp_path: Path) -> None:
    """Python puts the working directory first on the path."""
    (tmp_path / "models.py").write_text("")
    done = run_python(tmp_path, "-c", "import tangent_train")
    assert "models.py has the name of a package of tangent-train: rename it" in done.stderr
