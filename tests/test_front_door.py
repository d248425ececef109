"""``import tangent_train``: fast, and with the names that people need first."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import models
import tangent_train
from models import UNet
from tests.cli.tiny_runs import run_command
from tests.running import run_python


def test_names_come_from_their_packages() -> None:
    from tangent_train import geometry, rendering
    from tangent_train.inference import api, applying

    assert tangent_train.TangentGrid is geometry.TangentGrid
    assert tangent_train.load is api.load
    assert tangent_train.apply is applying.apply
    for name in ("equirect_to_tangent", "tangent_to_equirect", "tangent_to_labels"):
        assert getattr(tangent_train, name) is getattr(rendering, name)
    for package in (tangent_train, models):
        assert set(package.__all__) <= set(dir(package))
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


def test_a_folder_with_modules_of_our_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python puts the working directory first on the path."""
    monkeypatch.chdir(tmp_path)
    Path("classes.json").write_text('["wall", "floor"]')
    torch.save(UNet(3, 2).state_dict(), "state.pt")
    settings = ("network=unet", "weights=state.pt", "normalization=imagenet", "levels=5")
    run_command(monkeypatch, "import", *settings, "classes=classes.json", "output=net.ckpt")
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    others = [tmp_path / f"{name}.py" for name in ("datamodules", "models")]
    for path in others:
        path.write_text("raise RuntimeError")
    code = "import tangent_train as tt; print(len(tt.load('net.ckpt').class_names))"
    done = run_python(tmp_path, "-c", code)
    assert done.stdout == "3\n", done.stderr
    for path, line in zip(others, done.stderr.splitlines(), strict=True):
        assert line.startswith(f"{path} is not used")
    for path in others:
        path.write_text("")
        done = run_python(tmp_path, "-c", f"import {path.stem}, tangent_train")
        assert f"ImportError: {path} is imported, but tangent-train has" in done.stderr
