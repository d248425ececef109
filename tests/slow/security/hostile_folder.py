"""A working directory full of files that libraries look for where they are started."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from tests.running import ROOT

_PROGRAM = """
import sys
from tangent_train.cli import main
if __name__ == "__main__":
    getattr(main, sys.argv[0].rpartition("tangent_")[2])()
"""

_MODULES = (
    *("cv2", "hydra", "json", "models", "numpy", "optuna", "selectors", "signal", "sitecustomize"),
    *("socket", "submitit", "threading", "torch"),
)


def make_hostile(folder: Path) -> Path:
    """Make a folder whose files end a process that reads them as its own, or leave a trace."""
    folder.mkdir()
    for name in _MODULES:
        (folder / f"{name}.py").write_text(f"import os; os.write(2, b'{name} of this folder')\n")
    maps = Path("/proc/self/maps").read_text()
    library = re.search(r"/\S+/libm\.so\S*|/\S+/libc\.so\S*", maps)
    assert library is not None
    (folder / "libcuda.so.1").write_bytes(Path(library[0]).read_bytes())
    (folder / ".numba_config.yaml").write_text("a: b: c\n")
    (folder / "matplotlibrc").write_bytes(b"\xff\n")
    return folder


def run_in_hostile(
    folder: Path, command: str, *arguments: object
) -> subprocess.CompletedProcess[str]:
    """Run a command there as its console script does; the loader's reports are checked."""
    scripts = folder.parent / "scripts"
    scripts.mkdir(exist_ok=True)
    script = scripts / f"tangent_{command}"
    script.write_text(_PROGRAM)
    reports = folder.parent / "loaded"
    reports.mkdir(exist_ok=True)
    # Without the entry of OpenCV, which this process has imported.
    known = {"LD_LIBRARY_PATH": "", "LD_DEBUG": "libs", "LD_DEBUG_OUTPUT": str(reports / command)}
    done = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        check=False,
        cwd=folder,
        env={**os.environ, **known, "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": ""},
        capture_output=True,
        text=True,
    )
    assert "of this folder" not in done.stderr
    texts = [path.read_text(errors="replace") for path in reports.iterdir()]
    assert texts, "reports of the loader"
    assert not [text for text in texts if re.search(r"calling init: libcuda", text)]
    return done
