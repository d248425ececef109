"""What the source must not do anywhere: unpickle, evaluate text, start shells."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tangent_train", "datamodules", "models")
FORBIDDEN = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
READS_PICKLES = {"np.load", "np.save", "numpy.load", "numpy.save", "np.lib.format.read_array"}


def _calls() -> Iterator[tuple[str, ast.Call]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def _keyword(call: ast.Call, name: str) -> object:
    for keyword in call.keywords:
        if keyword.arg == name and isinstance(keyword.value, ast.Constant):
            return keyword.value.value
    return None


def test_arrays_are_read_and_written_without_pickles() -> None:
    calls = [(at, c) for at, c in _calls() if ast.unparse(c.func) in READS_PICKLES]
    assert calls, "else this looks at nothing"
    assert [at for at, call in calls if _keyword(call, "allow_pickle") is not False] == []


def test_tensors_are_read_without_pickles() -> None:
    calls = [(at, c) for at, c in _calls() if ast.unparse(c.func) == "torch.load"]
    assert calls, "else this looks at nothing"
    assert [at for at, call in calls if _keyword(call, "weights_only") is not True] == []


def test_nothing_that_unpickles_is_imported() -> None:
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                found += [path for name in names if name.partition(".")[0] in FORBIDDEN]
    assert found == []


def test_no_text_is_run() -> None:
    evaluating = {
        "eval",
        "exec",
        "compile",
        "os.system",
        "os.popen",
        "yaml.load",
        "yaml.unsafe_load",
    }
    assert [at for at, call in _calls() if ast.unparse(call.func) in evaluating] == []
    assert [at for at, call in _calls() if _keyword(call, "shell")] == []
