"""Means over folds and seeds against figures worked out by hand."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from tangent_train.errors import DataError
from tangent_train.results.reports.chart import report_png
from tangent_train.results.reports.groups import Figure, Group, group_runs
from tangent_train.results.reports.losses import largest_losses
from tangent_train.results.reports.paper import CLASSES, STANFORD_ROWS
from tangent_train.results.reports.runs import find_runs, load_run, unfinished_runs
from tangent_train.results.reports.tables import (
    notes,
    report_csv,
    report_json,
    report_markdown,
    report_tables,
)

NAMES = ("wall", "floor", "sofa")
FIGURES = ("iou", "accuracy", "iou_solid_angle", "accuracy_solid_angle")


def _config(changes: dict[str, Any]) -> dict[str, Any]:
    config = OmegaConf.create(
        {
            "name": "mine",
            "seed": 0,
            "level": 7,
            "data": {
                "_target_": "datamodules.Stanford2D3DS",
                "fold": 1,
                "seed": "${seed}",
                "inputs": ["rgb", "depth"],
                "test_rotation": None,
                "root": "/data",
            },
            "representation": {"base_level": 0},
            "optimizer": {"lr": 0.01},
        }
    )
    for name, value in changes.items():
        OmegaConf.update(config, name, value)
    container: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    return container


def _write(
    folder: Path,
    iou: list[float | None],
    names: tuple[str, ...] = NAMES,
    **changes: Any,
) -> Path:
    """A run with the same figure in all columns, its mean that of the classes that are there."""
    folder.mkdir(parents=True)
    present = [value for value in iou if value is not None]
    mean = sum(present) / len(present)
    results = {
        "images": 5,
        **dict.fromkeys(("miou", "macc", "miou_solid_angle", "macc_solid_angle"), mean),
        "absent_class": "skip",
        "classes": [
            {"class": name, **dict.fromkeys(FIGURES, value), "share": 0.1}
            for name, value in zip(names, iou, strict=True)
        ],
    }
    (folder / "results.json").write_text(json.dumps(results))
    config = _config({name.replace("__", "."): value for name, value in changes.items()})
    OmegaConf.save(OmegaConf.create(config), folder / "config.yaml")
    return folder


def _groups(*folders: Path) -> list[Group]:
    return group_runs([load_run(folder) for folder in find_runs(folders)])


@pytest.fixture
def three_folds(tmp_path: Path) -> Path:
    """Folds 1 (three seeds), 2 (one), 3 (two, without sofas)."""
    runs = tmp_path / "runs"
    for seed, wall in enumerate((0.1, 0.2, 0.6)):
        _write(runs / f"1_{seed}", [wall, 0.5, 0.5], data__fold=1, seed=seed)
    _write(runs / "2_0", [0.6, 0.8, 0.7], data__fold=2)
    for seed, wall in enumerate((0.8, 1.0)):
        _write(runs / f"3_{seed}", [wall, 0.2, None], data__fold=3, seed=seed, data__root="/other")
    return runs


def test_seeds_are_averaged_within_folds_and_then_the_folds(three_folds: Path) -> None:
    (group,) = _groups(three_folds)
    assert group.folds == (1, 2, 3)
    assert group.missing_folds == ()
    wall = group.figure("iou", 0)
    # Folds: (0.1 + 0.2 + 0.6) / 3 = 0.3, 0.6, 0.9. Not the mean of the six runs, 0.55.
    assert wall.mean == pytest.approx(0.6)
    assert wall.over_folds == pytest.approx(0.3)
    # Squares within folds: 0.04 + 0.01 + 0.09 and 0.01 + 0.01, over 2 + 1 degrees of freedom.
    assert wall.over_seeds == pytest.approx((0.16 / 3) ** 0.5)
    assert wall.folds == 3


def test_a_class_absent_from_a_fold_is_left_out_there_and_said(three_folds: Path) -> None:
    (group,) = _groups(three_folds)
    sofa = group.figure("accuracy", 2)
    assert sofa.mean == pytest.approx(0.6)
    assert sofa.over_folds == pytest.approx(0.02**0.5)
    assert sofa.over_seeds == pytest.approx(0)
    assert sofa.folds == 2
    (note,) = notes([group])
    assert "sofa (2 of 3)" in note
    assert "60.0 ± 14.1 (± 0.0) of 2 |" in report_markdown([group], [])


def test_a_class_in_no_fold_has_no_figure(tmp_path: Path) -> None:
    _write(tmp_path / "a", [0.5, 0.5, None])
    (group,) = _groups(tmp_path)
    assert group.figure("iou", 2) == Figure(None, None, None, 0)
    assert "| mine | 50.0 | 50.0 | – |" in report_markdown([group], [])
    assert report_png([group])


def test_other_settings_make_other_groups_named_by_what_differs(tmp_path: Path) -> None:
    for number, (rate, fold) in enumerate([(0.01, 1), (0.01, 2), (0.02, 1), (0.02, 2)]):
        _write(tmp_path / str(number), [0.1, 0.2, 0.3], optimizer__lr=rate, data__fold=fold)
    _write(tmp_path / "other", [0.1, 0.2, 0.3], name="other", optimizer__lr=0.03)
    groups = _groups(tmp_path)
    assert [(group.label, len(group.runs)) for group in groups] == [
        ("mine (optimizer.lr=0.01)", 2),
        ("mine (optimizer.lr=0.02)", 2),
        ("other", 1),
    ]


def test_fine_tuning_from_each_folds_own_checkpoint_is_one_group(tmp_path: Path) -> None:
    _write(tmp_path / "1", [0.1, 0.2, 0.3], init_from="a.ckpt", data__fold=1)
    _write(tmp_path / "2", [0.1, 0.2, 0.3], init_from="b.ckpt", data__fold=2)
    _write(tmp_path / "3", [0.1, 0.2, 0.3], init_from=None, data__fold=3)
    assert [group.folds for group in _groups(tmp_path)] == [(1, 2), (3,)]


def test_missing_folds_and_repeated_runs_are_said(tmp_path: Path) -> None:
    for name, fold in (("a", 1), ("b", 3), ("c", 3)):
        _write(tmp_path / name, [0.1, 0.2, 0.3], data__fold=fold)
    (group,) = _groups(tmp_path)
    assert group.missing_folds == (2,)
    missing, repeated = notes([group])
    assert missing.startswith("mine: fold 2 missing")
    assert repeated.endswith(f"fold 3, seed 0 more than once, also in {tmp_path / 'c'}.")
    assert "1, 3 only" in report_markdown([group], [])


def test_the_papers_row_is_that_of_the_same_data_resolution_and_inputs(tmp_path: Path) -> None:
    figures: list[float | None] = [0.5] * 13
    cases: dict[str, dict[str, Any]] = {
        "same": {},
        "s10": {"level": 10, "representation__base_level": 2, "data__inputs": ["rgb"]},
        "unprinted": {"level": 7, "representation__base_level": 1},
        "rgb": {"data__inputs": ["rgb"]},
        "turned": {"data__test_rotation": "so3"},
        "erp": {"representation__base_level": None},
        "made": {"data___target_": "datamodules.SynthRooms"},
    }
    found = {}
    for name, changes in cases.items():
        folder = _write(tmp_path / name, figures, CLASSES, **changes)
        (group,) = _groups(folder)
        found[name] = group.paper and (group.paper.level, group.paper.miou)
    assert found == dict.fromkeys(cases) | {"same": (7, 44.9), "s10": (10, 42.7)}


def test_made_rooms_stand_apart_from_the_papers_figures(tmp_path: Path) -> None:
    figures: list[float | None] = [0.5] * 13
    _write(tmp_path / "real", figures, CLASSES)
    _write(tmp_path / "made", figures, CLASSES, data___target_="datamodules.SynthRooms")
    text = report_markdown(_groups(tmp_path / "made", tmp_path / "real"), [])
    made, real = text.split("## Stanford2D3DS")
    assert "nothing here is comparable" in made
    assert "(paper)" not in made
    assert "| 7 | tangent images (paper) | RGB-D | 0 | 59.1 | 44.9 |" in real
    assert "| 7 | Lee et al. (paper) | RGB | 7 | 51.4 | – |" in real
    assert "| tangent images (paper), level 7 | 30.4 | 57.2 |" in real
    assert "level 10" not in real


def test_the_papers_means_are_those_of_its_classes() -> None:
    rows = [row for row in STANFORD_ROWS if row.iou]
    assert len(rows) == 5
    for row in rows:
        assert row.miou == pytest.approx(sum(row.iou) / 13, abs=0.06)
        assert row.macc == pytest.approx(sum(row.accuracy) / 13, abs=0.11)


def test_csv_and_json_hold_the_same_shares(three_folds: Path, tmp_path: Path) -> None:
    _write(tmp_path / "paper", [0.5] * 13, CLASSES)
    groups = _groups(three_folds)
    rows = list(csv.DictReader(io.StringIO(report_csv(groups))))
    (read,) = json.loads(report_json(groups, ["a note"]))["groups"]
    assert len(rows) == 4 + 3 * 4
    for row in rows:
        figures = read["means"] if row["class"] == "mean" else read["classes"][row["class"]]
        figure = figures[row["figure"]]
        assert float(row["mean"]) == figure["mean"]
        assert int(row["folds"]) == figure["folds"]
    assert read["means"]["miou"]["mean"] == groups[0].figure("miou").mean
    (beside,) = _groups(tmp_path / "paper")
    printed = json.loads(report_json([beside], []))["groups"][0]
    assert printed["means"]["miou"]["paper"] == pytest.approx(0.449)
    assert printed["classes"]["window"]["accuracy"]["paper"] == pytest.approx(0.586)
    assert printed["classes"]["window"]["iou_solid_angle"]["paper"] is None


def test_tables_for_the_terminal_take_any_name(tmp_path: Path) -> None:
    _write(tmp_path / "a", [0.1, 0.2, 0.3], name="[red]x|y")
    groups = _groups(tmp_path)
    console = Console(width=200, record=True, file=io.StringIO())
    for table in report_tables(groups):
        console.print(table)
    assert "[red]x|y" in console.export_text()
    assert r"| [red]x\|y |" in report_markdown(groups, [])


def test_the_chart_shows_a_bar_of_the_right_height(tmp_path: Path) -> None:
    def blue_rows(share: float) -> int:
        folder = _write(tmp_path / str(share), [share] * 3)
        encoded = np.frombuffer(report_png(_groups(folder)), np.uint8)
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        assert picture is not None
        blue = (picture == (0xB2, 0x72, 0x00)).all(-1)  # OpenCV's order
        return int(blue.any(1).sum())

    # Three rows of axes, and the legend's handle.
    low, middle, high = map(blue_rows, (0.0, 0.4, 0.8))
    assert high - middle == pytest.approx(middle - low, abs=8)
    assert high - low > 300


def test_the_chart_marks_the_papers_figures(tmp_path: Path) -> None:
    """At 44.9 and 59.1 % of the axes, above bars of 10 %; not where there is no row."""

    def marks(name: str, level: int) -> int:
        folder = _write(tmp_path / name, [0.1] * 13, CLASSES, level=level, name="long " * 20)
        encoded = np.frombuffer(report_png(_groups(folder)), np.uint8)
        picture = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        black = (picture < 60).astype(np.uint8)
        _, _, boxes, _ = cv2.connectedComponentsWithStats(black, connectivity=8)
        diamonds = (abs(boxes[:, 2] - 12) <= 3) & (boxes[:, 2] == boxes[:, 3]) & (boxes[:, 4] < 80)
        return int(diamonds.sum())

    assert marks("with", 7) - marks("without", 6) >= 2 + 13 + 13


def test_groups_of_unknown_data_lack_no_folds_and_have_names_of_their_own(tmp_path: Path) -> None:
    for number in range(3):
        changes: dict[str, Any] = {"data___target_": "my.Data", **dict.fromkeys("abcd", number)}
        _write(tmp_path / str(number), [0.1, 0.2, 0.3], **changes)
    _write(tmp_path / "3", [0.1, 0.2, 0.3], data___target_="my.Data", a=0, b=0, c=0, d=9)
    groups = _groups(tmp_path)
    assert [group.label for group in groups] == [
        "mine (a=0, b=0, c=0, …)",
        "mine (a=1, b=1, c=1, …)",
        "mine (a=2, b=2, c=2, …)",
        "mine (a=0, b=0, c=0, …) #2",
    ]
    assert [group.missing_folds for group in groups] == [()] * 4


def test_settings_are_what_is_written_and_nothing_is_looked_up(tmp_path: Path) -> None:
    folder = _write(tmp_path / "a", [0.1, 0.2, 0.3])
    with (folder / "config.yaml").open("a") as file:
        file.write("lr: ${optimizer.lr}\nhome: ${oc.env:HOME}\nmissing: ${b}\n")
    settings = load_run(folder).settings
    assert settings["optimizer.lr"] == 0.01
    found = [settings[name] for name in ("lr", "home", "missing")]
    assert found == ["${optimizer.lr}", "${oc.env:HOME}", "${b}"]


def test_runs_are_found_once_and_unfinished_ones_named(three_folds: Path) -> None:
    (three_folds / "cut" / "checkpoints").mkdir(parents=True)
    found = find_runs([three_folds / "2_0", three_folds])
    assert [path.name for path in found] == ["2_0", "1_0", "1_1", "1_2", "3_0", "3_1"]
    assert unfinished_runs([three_folds]) == [(three_folds / "cut").resolve()]
    with pytest.raises(DataError, match=r"cut/results.json: .*tangent-train resume=.*cut"):
        find_runs([three_folds / "cut"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "JSONDecodeError"),
        ("[]", "other lists and mappings"),
        ('{"miou": 0.5}', "no 'images'"),
        ('{"images": "5", "miou": 0.5}', "other lists and mappings"),
        ('{"images": 5, "miou": 0.5}', "no 'macc'"),
        (None, "no such file"),
    ],
)
def test_broken_results_are_named(content: str | None, message: str, tmp_path: Path) -> None:
    folder = _write(tmp_path / "a", [0.1, 0.2, 0.3])
    path = folder / "results.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=rf"a/results\.json: found .*{message}"):
        load_run(folder)


@pytest.mark.parametrize("value", [52.5, "0.5", True, -0.1])
def test_figures_must_be_shares(value: object, tmp_path: Path) -> None:
    folder = _write(tmp_path / "a", [0.1, 0.2, 0.3])
    results = json.loads((folder / "results.json").read_text())
    results["classes"][1]["iou"] = value
    (folder / "results.json").write_text(json.dumps(results))
    with pytest.raises(DataError, match=r"results\.json: .*expected shares of 1"):
        load_run(folder)


@pytest.mark.parametrize("content", [None, "[1, 2]", "a: &b 1\nc: *b", "a: [", "5"])
def test_broken_settings_are_named(content: str | None, tmp_path: Path) -> None:
    folder = _write(tmp_path / "a", [0.1, 0.2, 0.3])
    path = folder / "config.yaml"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"config\.yaml: found .*expected the settings"):
        load_run(folder)


def test_runs_with_other_classes_are_refused(tmp_path: Path) -> None:
    _write(tmp_path / "a", [0.1, 0.2, 0.3])
    _write(tmp_path / "b", [0.1, 0.2], ("wall", "road"))
    with pytest.raises(DataError, match=r"b/results\.json: .*wall, road.*a/results\.json.*apart"):
        _groups(tmp_path)


def test_a_folder_without_runs_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nor any below"):
        find_runs([tmp_path])
    with pytest.raises(DataError, match="no such folder"):
        find_runs([tmp_path / "nowhere"])


def _with_bands(folder: Path, bands: object) -> Path:
    _write(folder, [0.1, 0.2, 0.3])
    results = json.loads((folder / "results.json").read_text())
    results["latitude_bands"] = bands
    (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_bands_of_latitude_are_read_and_photos_have_none(tmp_path: Path) -> None:
    bands = [
        {"latitude_deg": [75, 90], "miou": 0.5, "macc": None},
        {"latitude_deg": [60, 75], "miou": 0.25, "macc": 0.75},
    ]
    run = load_run(_with_bands(tmp_path / "a", bands))
    assert run.bands == ((75.0, 90.0), (60.0, 75.0))
    assert run.figure("miou", band=(60.0, 75.0)) == 0.25
    assert run.figure("macc", band=(75.0, 90.0)) is None
    assert run.figure("miou", band=(0.0, 15.0)) is None
    nothing: dict[str, object] = {"empty": [], "null": None}
    for name, none in nothing.items():
        photos = load_run(_with_bands(tmp_path / name, none))
        assert photos.bands == ()
        assert photos.figure("miou", band=(75.0, 90.0)) is None
    assert load_run(_write(tmp_path / "b", [0.1, 0.2, 0.3])).bands == ()


@pytest.mark.parametrize(
    ("bands", "message"),
    [
        ([{"latitude_deg": [75, 90], "miou": 0.5}], "no 'macc'"),
        ([{"latitude_deg": [75], "miou": 0.5, "macc": 0.5}], "ValueError"),
        ([{"latitude_deg": [75, 90], "miou": 50, "macc": 0.5}], "shares of 1"),
        (5, "other lists"),
        ({"a": 1}, "other lists"),
    ],
)
def test_broken_bands_are_named(bands: object, message: str, tmp_path: Path) -> None:
    folder = _with_bands(tmp_path / "a", bands)
    with pytest.raises(DataError, match=rf"a/results\.json: .*{message}"):
        load_run(folder)


def test_photos_and_cubemaps_are_named_and_have_folds(tmp_path: Path) -> None:
    ways = {
        "photos": ("datamodules.SynthRoomsPerspective", "rendering.PerspectiveRepresentation"),
        "cubemap": ("datamodules.Stanford2D3DS", "rendering.CubemapRepresentation"),
        "ERP": ("datamodules.Stanford2D3DS", "rendering.EquirectRepresentation"),
    }
    for name, (data, representation) in ways.items():
        settings: dict[str, Any] = {
            "data___target_": data,
            "representation___target_": representation,
        }
        folder = _write(
            tmp_path / name, [0.1, 0.2, 0.3], representation__base_level=None, **settings
        )
        (group,) = _groups(folder)
        assert group.base_level == name
        assert group.missing_folds == (2, 3)
        assert group.paper is None
        made = "nothing here is comparable" in report_markdown([group], [])
        assert made == ("SynthRooms" in data)


def test_reports_say_how_many_images_were_scored(tmp_path: Path) -> None:
    folder = _write(tmp_path / "a", [0.1, 0.2, 0.3])
    assert load_run(folder).images == 5
    written = json.loads(report_json(_groups(folder), []))["groups"][0]["runs"][0]
    assert written["images"] == 5


def test_the_class_that_takes_most_from_the_mean_is_named(
    three_folds: Path, tmp_path: Path
) -> None:
    # Means over folds: walls 0.6, floors (0.5 + 0.8 + 0.2) / 3, sofas (0.5 + 0.7) / 2.
    (group,) = _groups(three_folds)
    sentence = "mine: largest loss: floor, 50.0 % IoU."
    assert largest_losses([group]) == [sentence]
    assert f"\n- {sentence}\n" in report_markdown([group], [])
    console = Console(width=160, record=True, file=io.StringIO())
    for table in report_tables([group]):
        console.print(table)
    assert sentence in console.export_text()

    folder = _write(tmp_path / "zero", [0.5, 0.4, 0.0])
    content = json.loads((folder / "results.json").read_text())
    content["classes"][2]["share"] = 0.0  # absent, counted as 0
    (folder / "results.json").write_text(json.dumps(content))
    assert largest_losses(_groups(folder)) == ["mine: largest loss: floor, 40.0 % IoU."]
    for entry in content["classes"]:
        entry["share"] = 0.0
    (folder / "results.json").write_text(json.dumps(content))
    assert largest_losses(_groups(folder)) == []
