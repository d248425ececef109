"""Names of files and classes stay names: no path out of a folder, no script in a page."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from datamodules.images.image_files import short_names
from datamodules.images.pixel_files import write_pixels
from tangent_train.cli.keypoints import file_name
from tangent_train.results.predictions import PredictionFolder
from tests.cli.tiny_runs import run_command
from tests.inference.trained import write_checkpoint

SCRIPT = '<img src=x onerror="alert(1)"><script>alert(1)<\\script>'
_PARTS = st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=12)


@given(st.lists(st.lists(_PARTS, min_size=1, max_size=4), min_size=1, max_size=4))
@example([["..", "..", "etc", "x.png"], ["a", "..", "..", "b"]])
@example([["..x"], ["...", "x"]])
def test_predictions_stay_in_their_folder(names: list[list[str]]) -> None:
    paths = [Path("images", *parts) for parts in names]
    folder = PredictionFolder(Path("/output"), ("unknown", "wall"), probabilities=True)
    for name in short_names(paths):
        for file in folder.files(name).values():
            assert file.is_relative_to("/output")
            assert ".." not in file.parts


@given(st.text())
@example("../../x")
@example("..")
@example("/etc/passwd")
def test_pictures_of_pairs_stay_in_their_folder(name: str) -> None:
    assert Path("/output", file_name(name)).parent == Path("/output")
    assert file_name(name).strip(".")


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


class _Page(HTMLParser):
    """Elements of a page, and the text outside of scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_a_report_of_hostile_names_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of files, folders and classes, through tangent-predict."""
    path = write_checkpoint(tmp_path / "x.ckpt")
    content = torch.load(path, weights_only=True)
    content["class_names"] = ["unknown", SCRIPT, "</script><script>alert(2)</script>", "a | b"]
    torch.save(content, path)
    images = tmp_path / "images" / '"><script>alert(3)<'
    images.mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 255, (32, 64, 3), np.uint8)
    for name in (f"{SCRIPT}.png", "--><b onclick=alert(4)>.png", "a\nb.png", "'; x.png"):
        write_pixels(images / name, noise)
    monkeypatch.chdir(tmp_path)
    run_command(
        monkeypatch, "predict", "checkpoint=x.ckpt", "input=images", "output=o", "device=cpu"
    )
    text = (tmp_path / "o" / "report.html").read_text()
    page = _Page()
    page.feed(text)
    scripts = [attributes for tag, attributes in page.found if tag == "script"]
    assert [s for s in scripts if not s] == [{}], "the page's own, once"
    assert {s.get("type") for s in scripts if s} == {"application/json", "x-shader/x-fragment"}
    assert not any(name.startswith("on") for _, attributes in page.found for name in attributes)
    assert {a["src"][:16] for tag, a in page.found if tag == "img" and a.get("src")} == {  # type: ignore[index]
        "data:image/jpeg;"
    }
    assert "b" not in {tag for tag, _ in page.found}
    assert "default-src 'none'" in text
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    inside = [path for path in written if path.is_relative_to(tmp_path / "o")]
    assert len(written) - len(inside) == 5, "the checkpoint and the images"
    assert len(inside) == 4 * 3 + 4
