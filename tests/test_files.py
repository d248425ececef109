from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, write_text


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a" / "file.txt"
    write_text(path, "old ü")

    def cut_off() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("cut off")

    with pytest.raises(RuntimeError, match="cut off"):
        cut_off()
    assert path.read_text(encoding="utf-8") == "old ü"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("kind", [DataError, SettingError])
def test_errors_say_everything_and_survive_another_process(kind: type[DataError]) -> None:
    error = kind("data.fold", found=4, expected="1, 2 or 3", remedy="Choose one of these.")
    message = "data.fold: found 4; expected 1, 2 or 3. Choose one of these."
    assert str(error) == message
    assert str(pickle.loads(pickle.dumps(error))) == message
    assert isinstance(error, ValueError)
