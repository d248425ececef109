"""The report's page: names stay text, nothing outside is referred to, images fit."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tangent_train.results.page import encode_image, write_report
from tangent_train.results.tables import Table
from tests.decoded import decoded

NASTY = """</script><script>throw 1</script><!-- <b>&amp; "it's" {{images}} <!--images-->"""
NAMES = ("unknown", "wall", "floor", NASTY)


class _Reader(HTMLParser):
    """Elements, attributes and texts as a browser would take them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: list[str] = []
        self.scripts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_data(self, data: str) -> None:
        inside_script = self.tags and self.tags[-1] == "script" and self.cdata_elem is not None
        (self.scripts if inside_script else self.texts).append(data)


@pytest.fixture
def nasty_page(tmp_path: Path) -> str:
    labels = np.array([[0, 1], [2, 3]], np.uint8)
    rgb = np.zeros((4, 8, 3), np.uint8)
    image = encode_image(NASTY, rgb, len(NAMES), prediction=labels, truth=labels, note=NASTY)
    path = tmp_path / "report.html"
    write_report(
        path,
        title=NASTY,
        tables=[Table(NASTY, (NASTY, "x"), [(NASTY, NASTY)], NASTY)],
        images=[image, image],
        class_names=NAMES,
        notes=[NASTY],
    )
    return path.read_text(encoding="utf-8")


def test_names_stay_text_wherever_they_stand(nasty_page: str) -> None:
    reader = _Reader(nasty_page)
    # title, heading, note; table: title, note, header, 2 cells; 2 thumbnails with notes.
    assert sum(NASTY in text for text in reader.texts) == 12
    assert "b" not in reader.tags
    assert reader.tags.count("script") == 6, "2 images, classes, colors, shader, viewer"
    images = [json.loads(s) for s in reader.scripts if s.startswith('{"name"')]
    assert [image["name"] for image in images] == [NASTY, NASTY]
    (classes,) = (json.loads(s) for s in reader.scripts if s.startswith("[{"))
    assert [entry["name"] for entry in classes] == list(NAMES)
    assert classes[0]["rgb"] == [136, 136, 136]


def test_the_page_refers_to_nothing_outside_and_forbids_it(nasty_page: str) -> None:
    reader = _Reader(nasty_page)
    for tag, name, value in reader.attributes:
        if name in ("src", "href", "srcset", "action"):
            assert value.startswith("data:"), (tag, name)
    assert not {"iframe", "object", "embed"} & set(reader.tags)
    style = nasty_page.partition("<style>")[2].partition("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    policy = next(v for t, n, v in reader.attributes if n == "content" and "default-src" in v)
    assert policy.startswith("default-src 'none'; img-src data: blob:;")


def test_printed_tables_and_markdown_take_any_text_and_lose_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    cells = ["a|b" * 40, "[/] " * 20 + "end"]
    table = Table("[t]", ("", "[red]"), [cells], "[note]")
    table.print()
    shown = capsys.readouterr().out
    assert all(text in shown for text in ("[t]", "[red]", "[note]"))
    assert (shown.count("a"), shown.count("b"), shown.count("[/]")) == (40, 40, 20)
    assert "| " + r"a\|b" * 40 + " | [/] [/] " in table.markdown()


CLASSES = 14


def test_a_larger_image_is_shrunk_by_area_and_its_labels_to_the_nearest() -> None:
    rgb = np.zeros((256, 8192, 3), np.uint8)
    rgb[:, 1::2] = 200  # stripes of one pixel: only their mean may be left
    labels = np.zeros((256, 8192), np.uint8)
    labels[100:200, 2000:5000] = 7
    image = encode_image("large", rgb, CLASSES, prediction=labels, sphere=False)
    assert (image.width, image.height) == (8192, 256)
    shrunk = decoded(image.input)
    assert shrunk.shape == (128, 4096, 3)
    assert np.abs(shrunk.astype(int) - 100).max() <= 2
    np.testing.assert_array_equal(decoded(image.prediction)[50:100, 1000:2500], 7)
    assert np.count_nonzero(decoded(image.prediction)) == 50 * 1500


def test_all_objects_are_in_the_page() -> None:
    """The class is red, the number of the object green + 256 blue."""
    numbers = np.arange(60 * 20).reshape(60, 20)
    labels = np.full(numbers.shape, 7, np.uint8)
    rgb = np.zeros((*numbers.shape, 3), np.uint8)
    image = encode_image("", rgb, CLASSES, prediction=labels, numbers=numbers, objects={})
    red, green, blue = np.moveaxis(decoded(image.prediction).astype(int), -1, 0)
    np.testing.assert_array_equal(red, 7)
    np.testing.assert_array_equal(green + 256 * blue, numbers)


def test_shares_are_of_the_solid_angle_on_panoramas_and_of_the_pixels_on_photos() -> None:
    labels = np.ones((90, 180), np.uint8)
    labels[:15] = 2  # the cap above 60°: (1 - sin 60°) / 2 of the sphere, 1/6 of the pixels
    rgb = np.zeros((90, 180, 3), np.uint8)
    cap = (1 - np.sin(np.radians(60))) / 2
    for sphere, share in ((True, cap), (False, 1 / 6)):
        image = encode_image("", rgb, CLASSES, prediction=labels, truth=labels, sphere=sphere)
        expected = [(1, 1 - share, 1 - share), (2, share, share)]
        np.testing.assert_allclose(image.shares, expected, atol=1e-12)
