"""Calls that no source file may make: unpickling, evaluating text, starting a shell."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tangent_train", "datamodules", "models")
UNPICKLING = {"pickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
EVALUATING = {"eval", "exec", "compile", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load"}
MUST_SAY = {
    "np.load": "allow_pickle=False",
    "np.save": "allow_pickle=False",
    "np.lib.format.read_array": "allow_pickle=False",
    "torch.load": "weights_only=True",
}


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_unpickles_or_evaluates_text(package: str) -> None:
    calls = 0
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [getattr(node, "module", None) or alias.name for alias in node.names]
                assert not UNPICKLING & {name.partition(".")[0] for name in names}, path
            elif isinstance(node, ast.Call):
                calls += 1
                called, keywords = ast.unparse(node.func), set(map(ast.unparse, node.keywords))
                assert called not in EVALUATING, path
                assert "shell=True" not in keywords, path
                assert called not in MUST_SAY or MUST_SAY[called] in keywords, path
    assert calls
