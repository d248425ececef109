from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import features

from tangent_train.errors import DataError
from tangent_train.io.image_files import NamedFiles, find_depth, glob_files, image_paths


def _touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_a_folder_is_searched_for_images_only(tmp_path: Path) -> None:
    names = ["b.JPG", "a.png", "deep/er/c.TIFF", "deep/d.webp", "e.jpeg", "f.tif", "g.bmp", "h.GIF"]
    names += ["i.avif"] if features.check("avif") else []
    names += ["phone.HEIC", "deep/phone.jxl", "raw.DNG"]  # refused when they are read
    others = ["notes.txt", ".hidden.jpg", ".thumbnails/a.jpg", "jpg", "deep/x.jpg.part"]
    others += ["escape.\x1b[2J", "._a.jpg", ".DS_Store", "Thumbs.db", "deep/desktop.ini"]
    others += ["@eaDir/a.jpg", "deep/@eaDir/d.webp/thumb.jpg"]
    _touch(*(tmp_path / name for name in names + others))
    (tmp_path / "folder.png").mkdir()
    messages: list[str] = []
    found = image_paths(tmp_path, tell=messages.append)
    assert found == sorted(tmp_path / name for name in names)
    assert image_paths(str(tmp_path)) == found
    counts = r"Skipped: 1 .\x1b[2j, 1 .part, 1 .txt, 1 without suffix. Convert"
    assert [text.partition(" images")[0] for text in messages] == [counts]
    image_paths(tmp_path / "*.png", tell=messages.append)
    assert len(messages) == 1


def test_names_may_have_the_characters_of_a_pattern(tmp_path: Path) -> None:
    odd, inside = tmp_path / "room [1] *.panorama", tmp_path / "[ab]" / "x.png"
    _touch(odd, inside, tmp_path / "room 1 x.jpg", tmp_path / "a" / "y.png")
    assert image_paths(odd) == [odd]
    assert image_paths(tmp_path / "[ab]") == [inside]


def test_patterns_select_images(tmp_path: Path) -> None:
    _touch(*(tmp_path / name for name in ("a1.jpg", "a2.png", "b1.jpg", "s/a3.JPG", "s/t/a4.jpg")))
    _touch(tmp_path / "a5.txt", tmp_path / ".a6.jpg", tmp_path / "@eaDir" / "a7.jpg")

    def names(pattern: str) -> list[str]:
        return [str(path.relative_to(tmp_path)) for path in image_paths(tmp_path / pattern)]

    assert names("a*") == ["a1.jpg", "a2.png"]
    assert names("[ab]1.jpg") == ["a1.jpg", "b1.jpg"]
    assert names("**/a?.*") == ["a1.jpg", "a2.png", "s/a3.JPG", "s/t/a4.jpg"]
    assert image_paths(tmp_path / "@eaDir" / "*.jpg") == [tmp_path / "@eaDir" / "a7.jpg"]
    _touch(tmp_path / "s" / "._a3.JPG", tmp_path / ".trash" / "a8.JPG", tmp_path / "@eaDir/a9.JPG")
    assert glob_files(tmp_path, "*/*.JPG") == [tmp_path / "s" / "a3.JPG"], "of data sets"


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("nowhere.jpg", "found no such file or folder"),
        ("notes", "found 2 files, none of them an image: 1 .pdf, 1 .txt"),
        ("empty", "found nothing"),
    ],
)
def test_missing_images_are_refused(tmp_path: Path, pattern: str, found: str) -> None:
    _touch(
        *(
            tmp_path / name
            for name in ("notes.txt", "notes/a.PDF", "notes/b.txt", "notes/Thumbs.db")
        )
    )
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=rf"{re.escape(pattern)}: {found}.*\.webp") as caught:
        image_paths(tmp_path / pattern)
    assert ("Convert images of other formats" in str(caught.value)) == ("2 files" in found)


def test_depth_is_found_by_the_name_of_the_image(tmp_path: Path) -> None:
    _touch(tmp_path / "a" / "x.png", tmp_path / "a" / "y_depth.exr", tmp_path / "a" / "z.txt")
    _touch(tmp_path / "B" / "w_depth.TIF", tmp_path / "B" / "@eaDir" / "x.png")
    depths = NamedFiles(tmp_path)
    assert find_depth(depths, "a/x", "") == tmp_path / "a" / "x.png"
    assert find_depth(depths, "a/y", "") == tmp_path / "a" / "y_depth.exr"
    assert find_depth(depths, "B/w", "") == tmp_path / "B" / "w_depth.TIF"
    assert depths.path("a/x.PNG") == depths.path("a/x.png")
    with pytest.raises(DataError, match=r"a.z: found no such file; .*_depth.* Remedy"):
        find_depth(depths, "a/z", "Remedy")
    _touch(tmp_path / "a" / "x_depth.npy")
    with pytest.raises(DataError, match=r"a.x: found x\.png, x_depth\.npy; expected one file"):
        find_depth(NamedFiles(tmp_path), "a/x", "Remedy")
