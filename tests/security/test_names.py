"""Names of files and classes stay names: no path out of a folder, no script in a page."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from datamodules.images.image_files import short_names
from datamodules.images.pixel_files import write_pixels
from tangent_train.results.predictions import PredictionFolder
from tests.cli.tiny_runs import run_command

_PARTS = st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=12)


@given(st.lists(st.lists(_PARTS, min_size=1, max_size=4), min_size=1, max_size=4))
@example([["..", "..", "etc", "x.png"], ["a", "..", "..", "b"]])
@example([["..x"], ["...", "x"]])
def test_predictions_stay_in_their_folder(names: list[list[str]]) -> None:
    paths = [Path("images", *parts) for parts in names]
    folder = PredictionFolder(Path("/output"), ("unknown", "wall"), ("labels", "probabilities"))
    for name in short_names(paths):
        for file in folder.files(name).values():
            assert file.is_relative_to("/output")
            assert ".." not in file.parts


def test_names_in_a_list_of_cameras_lead_nowhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crafted cameras.json beside tangent images, which are then rendered again and put back."""
    monkeypatch.chdir(tmp_path)
    write_pixels(tmp_path / "a.png", np.zeros((32, 64, 3), np.uint8))
    render = ["input=a.png", "output=tangent", "base_level=0", "level=4"]
    run_command(monkeypatch, "render", *render)
    file = tmp_path / "tangent" / "a" / "cameras.json"
    content = json.loads(file.read_text())
    precious = tmp_path / "precious.png"
    precious.write_bytes(b"mine")
    for image, name in zip(content["images"], ("../../precious.png", str(precious)), strict=False):
        image["file"] = name
    content["source"]["file"] = "../../../precious.png"
    file.write_text(json.dumps(content))
    with pytest.raises(SystemExit):
        run_command(monkeypatch, "render", "back=tangent/a", "output=back.png")
    with pytest.raises(SystemExit):  # a folder with other files than it lists
        run_command(monkeypatch, "render", *render, "overwrite=true")
    assert precious.read_bytes() == b"mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "precious.png", "tangent"]
