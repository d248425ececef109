from __future__ import annotations

from pathlib import Path

import pytest

from tangent_train.errors import SettingError
from tangent_train.manifest import Manifest, Shard

SETTINGS = {"checkpoint": "net.onnx", "area": (1, 2.5), "blend": "feather"}


def test_a_folder_with_the_same_settings_continues_with_what_is_missing(tmp_path: Path) -> None:
    out = tmp_path / "a" / "out"
    first = Manifest.open(out, SETTINGS)
    first.finish("b.png", rows=4)
    with (out / "finished.jsonl").open("a") as file:
        file.write('{"item": "c.png", "ro')  # killed while it wrote
    again = Manifest.open(out, SETTINGS)
    assert again.finished == {"b.png": {"rows": 4}}
    assert again.missing(["c.png", "b.png", "a.png"]) == ["c.png", "a.png"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"blend": "nearest"}, "blend: found nearest; expected feather, with which .*out"),
        ({"area": None}, r"area: found null; expected \[1, 2.5\]"),
    ],
)
def test_a_folder_with_other_settings_is_refused(
    change: dict[str, object], message: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    Manifest.open(out, SETTINGS).finish("a.png")
    with pytest.raises(SettingError, match=message):
        Manifest.open(out, SETTINGS | change)
    assert Manifest.open(out, SETTINGS).finished == {"a.png": {}}


def test_a_folder_without_finished_items_is_begun_anew(tmp_path: Path) -> None:
    Manifest.open(tmp_path, SETTINGS)
    other = SETTINGS | {"blend": "nearest"}
    Manifest.open(tmp_path, other).finish("a.png")
    assert Manifest.open(tmp_path, other).finished == {"a.png": {}}
    with pytest.raises(SettingError, match="blend: found feather; expected nearest"):
        Manifest.open(tmp_path, SETTINGS)


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("…")
    with pytest.raises(SettingError, match="holds other files"):
        Manifest.open(tmp_path, SETTINGS)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_shards_share_a_folder_and_together_finish_everything(tmp_path: Path) -> None:
    names = list("abcdefg")
    for number in (2, 1, 3):
        shard = Shard.parse(f"{number}/3")
        manifest = Manifest.open(tmp_path, SETTINGS, shard)
        for name in shard.part(names):
            manifest.finish(name, shard=number)
    found = Manifest.open(tmp_path, SETTINGS).finished
    assert {name: entry["shard"] for name, entry in found.items()} == {
        name: position % 3 + 1 for position, name in enumerate(names)
    }
    begun = tmp_path / "begun"
    Manifest.open(begun, SETTINGS, Shard(1, 2))
    with pytest.raises(SettingError, match="blend: found nearest; expected feather"):
        Manifest.open(begun, SETTINGS | {"blend": "nearest"}, Shard(2, 2))
    assert Manifest.open(begun, SETTINGS, Shard(2, 2)).finished == {}, "before the first item"
    with pytest.raises(SettingError, match="number/count"):
        Shard.parse("4/3")
