"""What a transfer keeps, against figures worked out by hand and the paper's own."""

from __future__ import annotations

import csv
import io
import json

import pytest
from rich.console import Console

from tangent_train.errors import DataError
from tangent_train.results.reports.groups import Figure
from tangent_train.results.reports.paper import CLASSES
from tangent_train.results.transfer.losses import largest_losses
from tangent_train.results.transfer.report import StageResult, TransferReport, gather
from tangent_train.results.transfer.tables import (
    transfer_csv,
    transfer_json,
    transfer_markdown,
    transfer_notes,
    transfer_tables,
)
from tests.results.transfer.transfer_runs import both, by_name, make_run, markdown_tables, stage


@pytest.fixture
def two_folds() -> TransferReport:
    """Two folds of two seeds, given in no order."""
    photos = {(2, 0): 0.8, (1, 0): 0.4, (1, 1): 0.6, (2, 1): 0.8}
    sphere = {(1, 1): 0.5, (1, 0): 0.3, (2, 1): 0.7, (2, 0): 0.9}
    return gather(both(photos, sphere)[::-1])


def test_figures_are_averaged_over_seeds_and_then_over_folds(two_folds: TransferReport) -> None:
    photos, sphere = two_folds.rows
    assert (photos.name, sphere.name) == ("P", "S")
    found = photos.figure("miou")
    assert found.mean == pytest.approx((0.5 + 0.8) / 2)
    assert found.over_folds == pytest.approx(0.3 / 2**0.5)
    # Squares within folds: 0.01 + 0.01 and 0, over 1 + 1 degrees of freedom.
    assert found.over_seeds == pytest.approx(0.1)
    assert found.folds == 2
    assert sphere.figure("macc").mean == pytest.approx((0.5 + 0.9) / 2)
    assert photos.figure("miou_solid_angle") == Figure(None, None, None, 0)


def test_what_is_kept_over_folds_is_the_ratio_of_the_means(two_folds: TransferReport) -> None:
    kept = by_name(two_folds)["S"].kept("miou")
    # Folds: 0.4 / 0.5 = 0.8 and 0.8 / 0.8 = 1; not their mean, 0.9.
    assert kept.mean == pytest.approx(0.6 / 0.65)
    assert kept.over_folds == pytest.approx(0.2 / 2**0.5)
    # Seeds: 3/4 and 5/6, 9/8 and 7/8; half the squared differences, over 2 degrees of freedom.
    assert kept.over_seeds == pytest.approx((((1 / 12) ** 2 / 2 + 0.25**2 / 2) / 2) ** 0.5)
    first = two_folds.of_fold(1)
    assert by_name(first)["S"].kept("miou").mean == pytest.approx(0.8)
    assert by_name(first)["S"].kept("miou").over_folds is None
    assert first.folds == (1,)
    assert by_name(two_folds)["P"].kept("miou").mean is None
    of_sphere = by_name(two_folds)["S"].kept("miou_solid_angle")
    assert of_sphere.mean == pytest.approx(0.3 / 0.65), "against the photos' pixels"
    assert by_name(two_folds)["P"].kept("miou_solid_angle").mean is None


def test_a_ratio_pairs_the_folds_and_seeds_that_both_have() -> None:
    photos = {(1, 0): 0.4, (1, 1): 0.8, (2, 0): 0.9}
    report = gather(both(photos, {(1, 0): 0.2, (3, 0): 0.9}))
    sphere = by_name(report)["S"]
    assert sphere.figure("miou").mean == pytest.approx(0.55)
    assert sphere.kept("miou") == Figure(0.5, None, None, 1)
    notes = "\n".join(transfer_notes(report))
    assert "P: fold 3 missing." in notes
    assert "S: fold 2 missing." in notes
    assert "S and P have other folds and seeds" in notes


def test_stages_are_paired_by_their_epochs_and_ordered_as_in_the_paper() -> None:
    names = ("S-FT-10", "S erp", "P-FT-1", "S", "P", "S-FT-1")
    results = [
        stage(name, make_run(0.5), representation="erp" if "erp" in name else "") for name in names
    ]
    report = gather(results)
    partners = [(row.name, row.partner and row.partner.name) for row in report.rows]
    assert partners == [
        ("P", None),
        ("S", "P"),
        ("S erp", "P"),
        ("P-FT-1", None),
        ("S-FT-1", "P-FT-1"),
        ("S-FT-10", None),
    ]
    assert any("S-FT-10: no photos with 10 epochs" in note for note in transfer_notes(report))
    (text, *_) = [
        found for found in transfer_markdown(report).splitlines() if found.startswith("| S-FT-10 |")
    ]
    assert text == "| S-FT-10 | tangent images | 60.0 | – | – | 50.0 | – | – | 25.0 | – |"


def test_the_markdown_tables_are_well_formed_and_say_what_is_kept(
    two_folds: TransferReport,
) -> None:
    tables = markdown_tables(transfer_markdown(two_folds))
    mean = tables["Mean of folds 1 and 2"]
    assert mean[0] == [
        "stage", "run on", "mAcc %", "change", "kept", "mIoU %", "change", "kept",
        "mIoU % by solid angle", "kept",
    ]  # fmt: skip
    # mAcc is 0.1 above: 0.7 / 0.75; folds 0.5 / 0.6, 0.9 / 0.9.
    assert mean[2][3] == "−6.7 %"
    assert mean[2][4].startswith("93.3 % ± 11.8 (± ")
    assert mean[2][5] == "60.0 ± 28.3 (± 14.1)"
    assert mean[2][6:8] == ["−7.7 %", "92.3 % ± 14.1 (± 13.2)"]
    assert mean[2][8] == "30.0 ± 14.1 (± 7.1)"
    assert mean[2][9].startswith("46.2 % ± ")
    assert mean[1][6:] == ["–", "–", "–", "–"]
    assert tables["Fold 1"][2][5:7] == ["40.0 (± 14.1)", "−20.0 %"]
    assert tables["Fold 2"][2][6] == "+0.0 %"
    assert tables["mIoU % by latitude, mean of folds 1 and 2"] == [
        ["latitude", "S"],
        ["45° … 90°", "60.0"],
        ["−90° … 45°", "30.0"],
    ]
    assert len(tables["stage"]) == 1 + 8
    assert all("paper" not in cell for cell in mean[0])


def test_one_fold_and_one_seed_has_one_table_without_spreads() -> None:
    report = gather(both({(2, 0): 0.4}, {(2, 0): 0.41}))
    tables = markdown_tables(transfer_markdown(report))
    assert [title for title in tables if title.lower().startswith(("fold", "mean"))] == ["Fold 2"]
    assert tables["Fold 2"][2][2:] == ["51.0", "+2.0 %", "102.0 %", "41.0", "+2.5 %", "102.5 %", "20.5", "51.2 %"]  # fmt: skip  # noqa: E501


def test_data_without_folds_is_one_test_set() -> None:
    runs = [stage(name, make_run(value), None) for name, value in (("P", 0.5), ("S", 0.4))]
    report = gather(runs)
    assert report.folds == (None,)
    tables = markdown_tables(transfer_markdown(report))
    assert tables["One test set"][2][5:8] == ["40.0", "−20.0 %", "80.0 %"]
    assert {row["fold"] for row in csv.DictReader(io.StringIO(transfer_csv(report)))} == {
        "",
        "mean",
    }


def test_classes_stand_side_by_side_with_their_change() -> None:
    report = gather(
        [
            stage("P", make_run(0.5, classes=(0.4, 0.5)), 1),
            stage("P", make_run(0.5, classes=(0.8, None)), 2),
            stage("S", make_run(0.5, classes=(0.2, 0.6)), 1),
            stage("S", make_run(0.5, classes=(0.8, 0.9)), 2),
            stage("S cubemap", make_run(0.5, classes=(0.3, None)), 1, representation="cubemap"),
        ]
    )
    tables = markdown_tables(transfer_markdown(report))
    assert tables["Classes: IoU %, mean of folds 1 and 2"] == [
        ["class", "P", "S", "change", "S cubemap", "change"],
        ["wall", "60.0", "50.0", "−16.7 %", "30.0", "−25.0 %"],
        # Floors of fold 1 alone: 0.6 / 0.5.
        ["floor", "50.0", "75.0", "+20.0 %", "–", "–"],
    ]
    assert tables["Classes: accuracy %, mean of folds 1 and 2"][1][:4] == [
        "wall", "70.0", "60.0", "−14.3 %",
    ]  # fmt: skip
    notes = "\n".join(transfer_notes(report))
    assert "P: classes not in every fold: floor (1 of 2)." in notes


def test_nothing_is_kept_of_nothing() -> None:
    report = gather(both({(1, 0): 0.0, (2, 0): 0.0}, {(1, 0): 0.2, (2, 0): 0.0}))
    assert by_name(report)["S"].kept("miou") == Figure(None, None, None, 0)
    assert "| 10.0 ± 14.1 | – | – |" in transfer_markdown(report)
    half = gather(both({(1, 0): 0.0, (2, 0): 0.4}, {(1, 0): 0.1, (2, 0): 0.1}))
    assert by_name(half)["S"].kept("miou").mean == pytest.approx(0.5)
    assert by_name(half)["S"].kept("miou").over_folds is None


def test_bands_that_are_not_defined_and_figures_that_are_nan_are_dashes() -> None:
    sphere = make_run(0.5, bands=(None, 0.4))
    sphere.results["classes"][0]["iou"] = float("nan")
    report = gather([stage("P", make_run(0.5)), stage("S", sphere)])
    tables = markdown_tables(transfer_markdown(report))
    assert tables["mIoU % by latitude, fold 1"][1:] == [["45° … 90°", "–"], ["−90° … 45°", "40.0"]]
    assert tables["Classes: IoU %, fold 1"][1] == ["wall", "50.0", "–", "–"]
    assert "NaN" not in transfer_json(report)


def test_photos_alone_make_a_report() -> None:
    report = gather([stage("P", make_run(0.5, photos=True))])
    assert report.group is None
    assert "latitude" not in transfer_markdown(report)
    assert json.loads(transfer_json(report))["data"] == {}
    assert len(transfer_tables(report)) == 1


def test_csv_and_json_hold_the_same_shares(two_folds: TransferReport) -> None:
    rows = list(csv.DictReader(io.StringIO(transfer_csv(two_folds))))
    # Two folds and their mean; 4 means, 4 figures of 2 classes; on panoramas 2 of 2 bands.
    assert len(rows) == 3 * (2 * (4 + 2 * 4) + 2 * 2)
    read = json.loads(transfer_json(two_folds))
    assert (read["made_by"], read["study"]) == ("tangent-transfer", "transfer")
    assert (read["folds"], read["seeds"]) == ([1, 2], [0, 1])
    assert len(read["runs"]) == 8
    assert all(run["images"] == 5 for run in read["runs"])
    stages = {
        (str(scope["fold"]), entry["stage"]): entry
        for scope in read["scopes"]
        for entry in scope["stages"]
    }
    for row in rows:
        entry = stages[row["fold"], row["stage"]]
        if row["south"]:
            (figures,) = (
                band
                for band in entry["latitude_bands"]
                if band["latitude_deg"] == [float(row["south"]), float(row["north"])]
            )
        else:
            figures = entry["means"] if row["class"] == "mean" else entry["classes"][row["class"]]
        figure = figures[row["figure"]]
        assert row["mean"] == ("" if figure["mean"] is None else str(figure["mean"]))
        kept = figure.get("kept", {}).get("mean")
        assert row["kept"] == ("" if kept is None else str(kept))
    assert stages["mean", "S"]["compared_with"] == "P"
    assert stages["mean", "S"]["means"]["miou"]["kept"]["mean"] == pytest.approx(0.6 / 0.65)


def test_tables_for_the_terminal_are_short_and_take_any_name() -> None:
    results = [stage("P", make_run(0.5)), stage("S [red]|", make_run(0.4, bands=(0.1, 0.2)))]
    console = Console(width=160, record=True, file=io.StringIO())
    for table in transfer_tables(gather(results)):
        console.print(table)
    text = console.export_text()
    assert "S [red]|" in text
    assert "−20.0 % (80.0 %)" in text
    assert "−90° … 45°" in text


@pytest.mark.parametrize(
    ("results", "message"),
    [
        ([], "found no stage"),
        (
            [stage("P", make_run(0.5)), stage("S", make_run(0.4, names=("wall", "road")))],
            "/runs/0.4/results.json: found classes wall, road; expected wall, floor",
        ),
        (
            [stage("S", make_run(0.5)), stage("S", make_run(0.4), 2, representation="erp")],
            "/runs/0.4: found stage S: panoramas, 0 epochs of fine-tuning, erp; expected panoramas",
        ),
        (
            [stage("S", make_run(0.5), 2, 7), stage("S", make_run(0.4), 2, 7)],
            "/runs/0.4: found stage S of fold 2, seed 7; expected each once; it is also in "
            "/runs/0.5",
        ),
    ],
)
def test_what_cannot_be_one_report_is_refused(results: list[StageResult], message: str) -> None:
    with pytest.raises(DataError) as error:
        gather(results)
    assert message in str(error.value)


def test_made_rooms_stand_apart_from_the_papers_figures(two_folds: TransferReport) -> None:
    text = transfer_markdown(two_folds)
    assert "Made rooms: nothing here is comparable" in text
    table = markdown_tables(text)["The paper, on Stanford2D3DS (real rooms; not comparable)"]
    assert table[2] == ["S", "57.4", "−7.1 %", "42.3", "−7.4 %"]
    assert {row["paper"] for row in csv.DictReader(io.StringIO(transfer_csv(two_folds)))} == {""}
    assert len(CLASSES) == 13


def test_the_class_that_the_transfer_costs_most_is_named() -> None:
    report = gather(
        [
            stage("P", make_run(0.5, classes=(0.4, 0.9)), 1),
            stage("P", make_run(0.5, classes=(0.8, None)), 2),
            stage("S", make_run(0.5, classes=(0.1, 0.8)), 1),
            stage("S", make_run(0.5, classes=(0.8, 0.1)), 2),
            stage("S erp", make_run(0.5, classes=(0.5, None)), 1, representation="erp"),
            stage("S-FT-1", make_run(0.5), 1),
        ]
    )
    # Walls lose 0.3 and 0 in the folds; floors 0.1 in the only one in which both have them.
    first, second = largest_losses(report)
    assert first == "S: wall loses most IoU from P: 60.0 % to 45.0 %."
    assert second == "S erp: no class loses IoU from P, wall gains least: 40.0 % to 50.0 %."
    assert f"\n- {first}\n- {second}\n\n" in transfer_markdown(report)
    console = Console(width=160, record=True, file=io.StringIO())
    for table in transfer_tables(report):
        console.print(table)
    assert first in console.export_text()
    assert second not in console.export_text()


def test_an_absent_class_that_counts_as_zero_is_not_what_the_transfer_costs() -> None:
    sphere = make_run(0.5, classes=(0.0, 0.3))
    sphere.results["classes"][0]["share"] = 0.0
    report = gather([stage("P", make_run(0.5)), stage("S", sphere)])
    assert largest_losses(report) == ["S: floor loses most IoU from P: 50.0 % to 30.0 %."]
    sphere.results["classes"][1]["share"] = 0.0
    assert largest_losses(report) == []
