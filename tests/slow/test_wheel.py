"""The wheel, installed in a clean environment and used from another folder."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    subprocess.run([*command, str(ROOT)], check=True, capture_output=True)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def scripts(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Console scripts of an environment that holds the wheel and, beside it, its dependencies."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment, with_pip=False)
    (site,) = environment.glob("lib/python*/site-packages")
    command = [sys.executable, "-m", "pip", "--python", str(environment / "bin" / "python")]
    subprocess.run(
        [*command, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True
    )
    # Files named *.pth in a folder added this way are not read: this checkout stays out of reach.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return environment / "bin"


def _run(folder: Path, program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command: list[str | Path] = [program, *arguments]
    return subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True)


def test_the_wheel_holds_the_packages_and_the_configs(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    wanted = (
        "tangent_train/configs/experiment/rooms/demo.yaml",
        "tangent_train/py.typed",
        "tangent_train/results/protocols.yaml",
        "tangent_train/results/published.csv",
        "tangent_train/inference/label_maps/ade20k_to_stanford2d3ds.json",
        "datamodules/tables/stanford2d3ds_pairs.csv",
        "models/unet.py",
    )
    assert set(wanted) <= set(names)
    assert not [name for name in names if name.startswith(("tests", "benchmarks", "data/"))]


def test_the_commands_answer_from_another_folder(
    scripts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    commands = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for command in commands:
        done = _run(tmp_path, scripts / command, "--help")
        assert done.returncode == 0, done.stderr
        assert command in done.stdout
    assert not list(tmp_path.iterdir())
