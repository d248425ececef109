"""``tangent-study`` from the command line to the files."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import cv2
import pytest
from PIL import Image

from tangent_train.cli import main
from tangent_train.cli.studies.catalogue import STUDIES
from tests.studies.mnist_format import write_mnist


def study(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["tangent-study", *map(str, arguments)])
    main.study()


def test_all_leaves_a_picture_and_a_file_of_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_mnist(tmp_path / "my=mnist")
    small = ("levels=2", "level=6", "side=16", "seeds=[0]", "epochs=1", "mnist=my=mnist")
    study(monkeypatch, "all", *small)
    left = {path.name for path in (tmp_path / "study").iterdir()}
    assert left == {f"{name}.{kind}" for name in STUDIES for kind in ("png", "csv")}
    said = capsys.readouterr().out
    for name in STUDIES:
        picture = cv2.imread(str(tmp_path / "study" / f"{name}.png"))
        assert picture is not None
        assert picture.std() > 1
        with Image.open(tmp_path / "study" / f"{name}.png") as image:
            assert image.info["Software"] == "tangent-study"
        with (tmp_path / "study" / f"{name}.csv").open() as file:
            lines = list(csv.DictReader(file))
        assert len(lines) >= 3
        assert f"study/{name}.png, .csv" in said
    assert "0.761918" in said


def test_earlier_studies_are_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "figures [1]"
    study(monkeypatch, "fov", f"output={output}")
    (output / "other.txt").write_text("mine")
    (output / "fov.csv").unlink()  # as an interrupted one leaves it
    study(monkeypatch, "fov", "level=7", f"output={output}")
    assert (output / "fov.csv").read_text().splitlines()[1].startswith("0,20,128,")
    assert (output / "other.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["fov.png", "fov.csv"])
def test_other_files_are_not_written_over(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(SystemExit, match=rf"output: found .*{name}.*did not write"):
        study(monkeypatch, "surface_area", "fov", f"output={tmp_path}")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == b"mine"


def test_pictures_of_others_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "fov.png")
    with pytest.raises(SystemExit, match=r"fov\.png, which tangent-study did not write"):
        study(monkeypatch, "fov", f"output={tmp_path}")


def test_help_lists_studies_and_settings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    study(monkeypatch, "--help")
    shown = capsys.readouterr().out
    for name, one in STUDIES.items():
        assert f"  {name} " in shown
        assert one.about in shown
        assert all(f"    {setting}=" in shown for setting in one.settings)
    study(monkeypatch)
    assert capsys.readouterr().out == shown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["surface_aera"], r"unknown study: found 'surface_aera'; .*mean surface_area\?"),
        (["nothing"], r"unknown study: found 'nothing'; expected surface_area, .*, all\.$"),
        (["--output"], r"unknown study: found '--output'.*Settings are written as output=fig"),
        (
            ["fov", "levl=3"],
            r"unknown setting: found 'levl'; expected output, level\. Did you",
        ),
        (["fov", "seeds=[1]"], r"'seeds'.*It is a setting of distorted_digits\."),
        (["fov", "+level=3"], r"unknown setting: found '\+level'"),
        (["level=3"], r"study: found none; expected one of surface_area"),
        (["fov", "level=ten"], r"level: found ten; expected a whole number, 4 or more"),
        (["fov", "level=1e1"], r"level: found 10\.0; expected a whole number"),
        (["fov", "level="], r"level: found nothing"),
        (["fov", "level=17"], r"level: found 17; expected 16 or less"),
        (["surface_area", "levels=13"], r"levels: found 13; expected 12 or less"),
        (["surface_area", "levels=-1"], r"levels: found -1; expected a whole number, 0 or more"),
        (["surface_area", "levels=[1"], r"levels: found \[1; expected"),
        (["representation_distortion", "side=48"], r"side: found 48; expected a power of 2"),
        (["distorted_digits", "seeds=0"], r"seeds: found 0; expected different whole numbers"),
        (["distorted_digits", "seeds=[]"], r"seeds: found \[\]"),
        (["distorted_digits", "seeds=[1,1]"], r"seeds: found \[1, 1\]"),
        (["distorted_digits", "seeds=[true]"], r"seeds: found \[True\]"),
        (["distorted_digits", "epochs=0"], r"epochs: found 0; expected a whole number, 1 or"),
        (["all", "mnist=nowhere"], r"nowhere: found no train-images-idx3-ubyte"),
    ],
)
def test_what_cannot_work_is_said_at_once(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=f"^tangent-study: .*{said}"):
        study(monkeypatch, *arguments)
    assert not list(tmp_path.iterdir())


def test_an_output_that_is_a_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(SystemExit, match=r"output: found .*file.* a folder that can be"):
            study(monkeypatch, "fov", f"output={output}")


def test_without_scikit_learn_no_work_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(SystemExit, match=r"no scikit-learn.*pip install 'tangent-train\[study\]'"):
        study(monkeypatch, "all")
    assert not list(tmp_path.iterdir())
