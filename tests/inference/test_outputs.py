"""The files of predictions, and what they must not touch."""

from __future__ import annotations

from pathlib import Path

import pytest

from tangent_train.errors import SettingError
from tangent_train.inference.outputs import OutputFolder, output_names

NAMES = ("unknown", "a", "b")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["photos/a.jpg"], ["a"]),
        (["photos/a.jpg", "photos/b.png"], ["a", "b"]),
        (["p/x/a.jpg", "p/y/a.jpg"], ["x/a", "y/a"]),
        (["p/a.jpg", "p/a.png", "p/A.tif", "p/b.c.jpg"], ["a.jpg", "a.png", "A.tif", "b.c"]),
        (["p/q/a.jpg", "b.jpg"], ["p/q/a", "b"]),
        (["1.jpg", "1.png", "1.jpg.png"], ["1.jpg", "1.png", "1.jpg.png"]),
        (["p/../p/q/../a.jpg", "p/b.jpg"], ["a", "b"]),
        (["a/x.jpg", "ab/x.jpg"], ["a/x", "ab/x"]),
        (["raum ü (1)/ä.jpg"], ["ä"]),
    ],
)
def test_names_are_short_and_unlike(paths: list[str], names: list[str]) -> None:
    assert output_names([Path(path) for path in paths]) == names


def test_earlier_results_are_not_overwritten_unless_told(tmp_path: Path) -> None:
    output = OutputFolder(tmp_path / "out", NAMES)
    output.check(["a", "b"], overwrite=False)
    file = output.files("b")["overlay"]
    file.parent.mkdir(parents=True)
    file.write_bytes(b"mine")
    with pytest.raises(SettingError, match=r"overlay/b\.png; expected .*overwrite=true"):
        output.check(["a", "b"], overwrite=False)
    output.check(["a"], overwrite=False)
    output.check(["a", "b"], overwrite=True)
    (tmp_path / "out" / "summary.csv").write_text("mine")
    with pytest.raises(SettingError, match=r"summary\.csv"):
        output.check(["a"], overwrite=False)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    for folder in (tmp_path / "out", tmp_path / "out" / "below"):
        with pytest.raises(SettingError, match="expected a folder"):
            OutputFolder(folder, NAMES).check(["a"], overwrite=True)
