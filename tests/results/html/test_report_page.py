from __future__ import annotations

import html
import json
import math
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from tangent_train.errors import SettingError
from tangent_train.metrics.segmentation import ConfusionMatrices
from tangent_train.results.html import Curve, Table, ViewerImage, write_report
from tangent_train.results.html.curves import curve_html, ticks
from tangent_train.results.html.evaluation import (
    evaluation_tables,
    image_note,
    training_curves,
    write_evaluation_report,
)
from tangent_train.results.html.parts import table_html
from tangent_train.results.segmentation import evaluation_results

if TYPE_CHECKING:
    from pathlib import Path

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


def _page(path: Path, **content: Any) -> str:
    write_report(path, **content)
    return path.read_text(encoding="utf-8")


@pytest.fixture
def nasty_page(tmp_path: Path) -> str:
    labels = np.array([[0, 1], [2, 3]], np.uint8)
    image = ViewerImage(NASTY, np.zeros((4, 8, 3), np.uint8), labels, labels, note=NASTY)
    return _page(
        tmp_path / "report.html",
        title=NASTY,
        tables=[Table(NASTY, (NASTY, "x"), [(NASTY, NASTY)], NASTY)],
        curves=[Curve(NASTY, NASTY, [0, 1], {NASTY: [0.0, 1.0]}, NASTY)],
        images=[image, image],
        class_names=NAMES,
        notes=[NASTY],
    )


def test_names_stay_text_wherever_they_stand(nasty_page: str) -> None:
    reader = _Reader(nasty_page)
    # title, heading, note; table: title, label, note, header, 2 cells; curve: card title, axes,
    # legend; 2 thumbnails with notes.
    assert sum(NASTY in text for text in reader.texts) >= 13
    assert "b" not in reader.tags
    assert reader.tags.count("script") == 5, "2 images, classes, shader, viewer"
    images = [json.loads(s) for s in reader.scripts if s.startswith('{"name"')]
    assert [image["name"] for image in images] == [NASTY, NASTY]
    (classes,) = (json.loads(s) for s in reader.scripts if s.startswith("[{"))
    assert [entry["name"] for entry in classes] == list(NAMES)
    assert classes[0]["rgb"] == [0, 0, 0]


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


def test_without_images_there_is_no_viewer(tmp_path: Path) -> None:
    page = _page(tmp_path / "report.html", title="Ä → 360°", notes=["one", "two"])
    reader = _Reader(page)
    assert not {"script", "canvas", "table", "svg"} & set(reader.tags)
    assert "<title>Ä → 360°</title>" in page
    assert [text for text in reader.texts if text in ("one", "two")] == ["one", "two"]
    assert "{{" not in page


def test_columns_of_numbers_are_aligned_to_the_right() -> None:
    rows = [("wall", "61.2", "–", "abc", "1e-05", "-30°"), ("floor", "7 %", "", "1", "3", "0")]
    text = table_html(Table("t", ("class", "a", "b", "c", "d", "e"), rows))
    header = re.search(r"<thead>.*</thead>", text)
    assert header is not None
    assert re.findall(r"<th\b( class=\"number\")?", header[0]) == [
        "",
        ' class="number"',
        ' class="number"',
        "",
        ' class="number"',
        ' class="number"',
    ]
    assert text.count('<td class="number">') == 8


def test_a_heat_map_shades_its_cells() -> None:
    shades = np.array([[0.25, 0.9]])
    text = table_html(Table("t", ("", "a", "b"), [("x", "25", "90")], shades=shades.tolist()))
    assert '<td style="--share:0.250">25</td>' in text
    assert '<td class="strong" style="--share:0.900">90</td>' in text


def test_rows_of_another_length_are_an_error() -> None:
    with pytest.raises(ValueError, match="zip"):
        table_html(Table("t", ("a", "b"), [("1", "2"), ("1",)]))


@pytest.mark.parametrize(
    ("least", "most"), [(0, 1), (-3, 7.2), (1e-5, 3e-3), (41, 59), (5, 5), (0, 0), (-1e9, 2e9)]
)
def test_ticks_are_few_round_and_enclose_the_range(least: float, most: float) -> None:
    values = ticks(least, most)
    assert values[0] <= least
    assert values[-1] >= most
    assert 3 <= len(values) <= 8
    step = values[1] - values[0]
    np.testing.assert_allclose(np.diff(values), step, rtol=1e-6)
    mantissa = step / 10 ** math.floor(math.log10(step) + 1e-9)
    assert min(abs(mantissa - m) for m in (1, 2, 5)) < 1e-6


def _svg(text: str) -> ET.Element:
    return ET.fromstring(text[text.index("<svg") : text.index("</svg>") + 6])


def _points(group: ET.Element) -> list[tuple[float, float]]:
    return [(float(c.attrib["cx"]), float(c.attrib["cy"])) for c in group.iter("circle")]


def test_points_lie_where_the_axes_say() -> None:
    """Positions read back through the labelled ticks of both axes give the values."""
    x, y = [0, 10, 20, 40], [0.0, 0.31, 0.77, 0.5]
    svg = _svg(curve_html(Curve("t", "y", x, {"a": y}, "step")))
    texts = [t for t in svg.iter("text") if "transform" not in t.attrib and t.text != "step"]
    along = {
        float(t.text or ""): float(t.attrib["x"]) for t in texts if t.get("text-anchor") != "end"
    }
    up = {
        float(t.text or ""): float(t.attrib["y"]) - 4
        for t in texts
        if t.get("text-anchor") == "end"
    }
    points = np.array(_points(svg))
    x_back = np.interp(points[:, 0], list(along.values()), list(along))
    y_back = np.interp(-points[:, 1], [-p for p in up.values()], list(up))
    np.testing.assert_allclose(x_back, x, atol=0.02)
    np.testing.assert_allclose(y_back, y, atol=0.001)
    titles = [t.text for t in svg.iter("title")]
    assert titles[1] == "a: 0.31 at step 10"


def test_gaps_stay_gaps_and_lonely_points_are_seen() -> None:
    nan = float("nan")
    svg = _svg(curve_html(Curve("t", "y", range(6), {"a": [1, 2, nan, 3, nan, float("inf")]})))
    (line,) = (p for p in svg.iter("path") if "line" in p.get("class", ""))
    assert [segment.count("L") for segment in line.attrib["d"].split("M")[1:]] == [1, 0]
    assert [c.get("class") for c in svg.iter("circle")] == ["point", "point", "point alone"]


def test_long_curves_are_drawn_through_means() -> None:
    x = np.arange(10_000)
    y = np.where(x % 2, 3.0, 1.0)  # mean 2
    y[5000:5050] = np.nan
    svg = _svg(curve_html(Curve("t", "y", x.tolist(), {"a": y.tolist()})))
    titles = [t.text or "" for t in svg.iter("title")]
    assert len(titles) == 199, "one group of 50 has no value"
    assert titles[0] == "a: 2 at epoch 24.5"
    assert all(" 2 at" in title for title in titles)


@pytest.mark.parametrize("x", [[], [3.0]])
def test_curves_without_a_line(x: list[float]) -> None:
    assert curve_html(Curve("t", "y", x, {"a": [float("nan")] * len(x)})) == ""
    assert curve_html(Curve("t", "y", x, {})) == ""
    if x:
        assert "alone" in curve_html(Curve("t", "y", x, {"a": [1.0]}))


def test_lines_fit_their_axis() -> None:
    with pytest.raises(SettingError, match=r"curve a: found \(2,\); expected \(3,\)"):
        curve_html(Curve("t", "y", [0, 1, 2], {"a": [0.0, 1.0]}))


def _results(*, photos: bool) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    bands = rng.integers(0, 50, (6, 4, 4))
    bands[:, 2] = 0  # no floor in the truth
    pixels = bands.sum(axis=0)
    solid = np.zeros((4, 4)) if photos else pixels * 0.01
    matrices = ConfusionMatrices(pixels, solid, bands, images=3)
    noun = "photos" if photos else "panoramas"
    return evaluation_results(matrices, ("unknown", "wall", "floor", "sofa"), "skip", noun)


@pytest.mark.parametrize("photos", [False, True])
def test_tables_hold_the_figures_of_the_results(photos: bool) -> None:
    results = _results(photos=photos)
    tables = {table.title: table for table in evaluation_tables(results)}
    assert ("By latitude" in tables) is not photos
    overall = tables["Overall"].rows
    assert overall[0] == (
        "by pixels",
        f"{100 * results['miou']:.1f}",
        f"{100 * results['macc']:.1f}",
    )
    assert len(overall) == (1 if photos else 2)
    classes = {row[0]: row for row in tables["Per class"].rows}
    assert classes["floor"][1] == "–"
    assert classes["wall"][1] == f"{100 * results['classes'][0]['iou']:.1f}"
    confusion, shades = tables["Confusion"].rows, tables["Confusion"].shades
    counts = np.array(results["confusion"])[1:, 1:]
    assert shades is not None
    np.testing.assert_allclose(np.array(shades)[[0, 2]].sum(axis=1), 1)
    assert confusion[1] == ("floor", "", "", "")
    assert confusion[0][1] == f"{100 * counts[0, 0] / counts[0].sum():.0f}"
    assert all(table_html(table) for table in tables.values())


def test_the_note_of_an_image_is_its_own_score() -> None:
    truth = np.array([[0, 1, 1], [1, 2, 2]])
    prediction = np.array([[1, 1, 1], [2, 2, 2]])
    # wall: 2 of 3 pixels, IoU 2/3; sofa: 2 found, 1 too many, IoU 2/3.
    assert image_note(truth, prediction, 3) == "mIoU 66.7\u00a0%, 80.0\u00a0% of pixels right"
    assert image_note(np.zeros((2, 2), int), np.ones((2, 2), int), 3) == ""


def test_the_curves_are_read_from_the_logs_of_the_run(tmp_path: Path) -> None:
    for start, stop in ((0, 60), (60, 100)):  # resumed: two files
        with SummaryWriter(str(tmp_path / "tensorboard")) as writer:
            for step in range(start, stop, 10):
                writer.add_scalar("train/loss", 100 - step, step)
                writer.add_scalar("lr-AdamW", 1e-3, step)
                writer.add_scalar("epoch", step // 50, step)
            writer.add_scalar("val/miou", 0.01 * stop, stop)
            writer.add_scalar("val/miou_solid_angle", 0.005 * stop, stop)
            writer.add_scalar("val/iou/wall", 0.5, stop)
    loss, validation, rate = training_curves(tmp_path)
    assert list(loss.x) == list(range(0, 100, 10))
    assert list(loss.series["training"]) == [100 - step for step in range(0, 100, 10)]
    assert set(validation.series) == {"mIoU", "mIoU by solid angle"}
    np.testing.assert_allclose(validation.series["mIoU"], [60, 100], rtol=1e-6)
    assert list(rate.series) == ["lr-AdamW"]


def test_a_checkpoint_without_logs_has_no_curves(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").mkdir()
    assert training_curves(tmp_path) == []
    assert training_curves(tmp_path / "missing") == []


@pytest.mark.parametrize("photos", [False, True])
def test_the_report_of_an_evaluation(tmp_path: Path, photos: bool) -> None:
    results = _results(photos=photos)
    path = tmp_path / "report.html"
    names = ("unknown", "wall", "floor", "sofa")
    write_evaluation_report(path, results, names, [], tmp_path / "a & b.ckpt")
    texts = _Reader(path.read_text(encoding="utf-8")).texts
    assert "Evaluation of a & b.ckpt" in texts
    noun = "photos" if photos else "panoramas"
    assert f"mIoU {100 * results['miou']:.1f}\u00a0%" in html.unescape(" ".join(texts))
    assert any(text.endswith(f"over 3 {noun}") for text in texts)
    assert any(text.startswith("By solid angle: ") for text in texts) is not photos
    assert any(text.startswith("Largest loss: ") for text in texts)
