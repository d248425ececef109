from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules.cityscapes import CLASSES as CITYSCAPES
from datamodules.core.dataset import Image
from datamodules.matterport360 import CLASSES as MATTERPORT
from datamodules.stanford2d3ds import files as stanford
from datamodules.structured3d import CLASSES as STRUCTURED3D
from tangent_train.geometry.sphere import area_mask
from tangent_train.heads.pictures import (
    mixed_picture,
    prediction_panel,
    shown_arrays,
    with_class_legend,
)
from tangent_train.io.palette import class_colors, colors_as_seen

PUBLISHED = Path(__file__).parents[1] / "inference" / "published_classes.json"
NAMES = ("unknown", "wall", "floor", "sofa")


def test_a_meaning_has_one_color_in_all_data_sets() -> None:
    indoors = dict(
        zip(stanford.CLASSES, class_colors(("unknown", *stanford.CLASSES))[1:], strict=True)
    )
    ade20k = json.loads(PUBLISHED.read_text())["ADE20K"]
    photos = dict(zip(ade20k, class_colors(("unknown", *ade20k))[1:], strict=True))
    streets = dict(zip(CITYSCAPES, class_colors(("unknown", *CITYSCAPES))[1:], strict=True))
    for name, other in {
        "bookcase": "cabinet",
        "ceiling": "ceiling",
        "door": "door, double door",
        "floor": "floor, flooring",
        "sofa": "sofa, couch, lounge",
        "wall": "wall",
        "window": "windowpane, window",
    }.items():
        assert (indoors[name] == photos[other]).all(), name
    assert (streets["wall"] == indoors["wall"]).all()
    for name in ("sky", "building", "sidewalk", "person", "car"):
        (other,) = (k for k in ade20k if k.split(",")[0] == name)
        assert (streets[name] == photos[other]).all(), name
    assert len(np.unique(class_colors(("unknown", *ade20k)), axis=0)) == 151
    with pytest.raises(ValueError, match="read-only"):
        class_colors(NAMES)[1] = 0


@pytest.mark.parametrize(
    ("names", "frequent"),
    [
        (stanford.CLASSES, "wall ceiling floor door bookcase clutter table chair board column"),
        (STRUCTURED3D, "wall floor ceiling cabinet door window curtain bed sofa table"),
        (MATTERPORT, "wall floor ceiling door window picture furniture table chair bed"),
        (CITYSCAPES, "road building vegetation car sidewalk sky pole person terrain fence"),
    ],
)
def test_frequent_classes_differ_for_every_kind_of_color_vision(
    names: tuple[str, ...], frequent: str
) -> None:
    labels = [0, *(1 + names.index(name) for name in frequent.split())]
    lab = colors_as_seen(class_colors(("unknown", *names))[labels])
    distances = np.linalg.norm(lab[:, None] - lab[None], axis=-1)[np.triu_indices(11, 1)]
    assert (distances.min(axis=0) > (26, 15, 15)).all()


def test_an_overlay_keeps_the_hues_of_the_classes() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    labels = np.ones((6, 8), np.uint8)
    labels[2:, 3:] = 2
    labels[5] = 0
    rgb[5, 0] = 0
    mixed = mixed_picture(rgb, labels, NAMES[:3]).astype(float)
    colors = class_colors(NAMES[:3])[labels].astype(float)
    light = 2 * mixed - colors  # gray, but for rounding
    inside = labels > 0
    inside[2, 3:] = inside[2:5, 3] = False
    assert np.ptp(light[inside], axis=-1).max() <= 2
    weights = [0.299, 0.587, 0.114]  # luma of ITU-R BT.601
    np.testing.assert_allclose(light[inside].mean(axis=-1), rgb[inside] @ weights, atol=2)
    np.testing.assert_array_equal(mixed[2, 3:], colors[2, 3:], "where a class begins")
    np.testing.assert_array_equal(mixed[2:5, 3], colors[2:5, 3])
    np.testing.assert_array_equal(mixed[5, 1:], rgb[5, 1:], "unknown")
    assert (mixed[5, 0] == 136).all(), "without a picture"


@pytest.mark.parametrize(("rows", "scale"), [(100, 2), (256, 1), (300, 1)])
def test_the_panel_shows_input_truth_prediction_and_error(rows: int, scale: int) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (rows, 2 * rows, 3), np.uint8)
    truth = rng.integers(0, 3, (rows, 2 * rows))
    prediction = np.where(truth == 0, 1, truth)
    prediction[:, :10] = 3
    panel = prediction_panel(rgb, truth, prediction, NAMES)
    height, width = scale * rows, scale * 2 * rows
    top, left = slice(22, 22 + height, scale), slice(0, width, scale)
    bottom = slice(44 + height, 44 + 2 * height, scale)
    right = slice(width + 8, 2 * width + 8, scale)
    np.testing.assert_array_equal(panel[top, left], rgb)
    np.testing.assert_array_equal(panel[top, right], class_colors(NAMES)[truth])
    np.testing.assert_array_equal(panel[bottom, left], class_colors(NAMES)[prediction])
    error = panel[bottom, right]
    assert np.all(error[(truth == 0)] == 136)
    assert np.all(error[(truth != 0) & (prediction == truth)] == 255)
    assert np.all(error[(truth != 0) & (prediction != truth)] == (214, 39, 40))
    assert panel.shape[0] > 44 + 2 * height, "a legend follows"


def test_a_partial_panorama_is_shown_cut_or_gray_around() -> None:
    valid = area_mask((90, -90, -45, 22.5), (32, 64))
    rng = np.random.default_rng(0)
    image = Image(
        rng.integers(1, 256, (32, 64, 3), np.uint8), None, np.ones((32, 64), np.uint8), valid=valid
    )
    labels = torch.ones(32, 64, dtype=torch.uint8)
    shown, *maps = shown_arrays(image, labels, labels, None, cut=False)
    np.testing.assert_array_equal(shown[valid], image.rgb[valid])
    assert (shown[~valid] == 136).all()
    for found in maps:
        np.testing.assert_array_equal(found, valid)
    rgb, truth, _ = shown_arrays(image, labels, labels, None)
    assert truth.shape == (12, 32)
    np.testing.assert_array_equal(rgb, image.rgb[12:24][:, np.r_[48:64, 0:16]])


def test_a_region_without_a_picture_is_gray_and_unknown() -> None:
    """Black pixels with a label are dark objects."""
    rgb = np.full((4, 8, 3), 9, np.uint8)
    rgb[:2] = 0
    truth = torch.tensor([[0], [1], [0], [2]]).expand(4, 8)
    image = Image(rgb, None, truth.numpy())
    shown, *maps = shown_arrays(image, truth, torch.ones(4, 8, dtype=torch.int64), None)
    np.testing.assert_array_equal(shown[:, 0, 0], [136, 0, 9, 9])
    np.testing.assert_array_equal(np.stack(maps)[:, :, 0], [[0, 1, 0, 2], [0, 1, 1, 1]])
    distances = torch.where(truth > 0, 2.5, torch.nan)
    _, *maps = shown_arrays(image, distances, torch.full((4, 8), 2.0), None, unknown=math.nan)
    np.testing.assert_array_equal(maps[1][:, 0], [np.nan, 2, 2, 2])


def test_a_legend_begins_with_the_largest_class_and_leaves_out_others() -> None:
    labels = np.repeat([2, 3, 3, 3, 2, 3], 200).reshape(6, 200)
    picture = np.zeros((6, 200, 3), np.uint8)
    legend = with_class_legend(picture, labels, NAMES)[6:]
    colors = class_colors(NAMES)
    rows = [(legend == colors[k]).all(axis=-1).nonzero()[0] for k in (3, 2, 1)]
    assert len(rows[0]) == len(rows[1]) == 12 * 12
    assert rows[0].max() < rows[1].min(), "a row each"
    assert not len(rows[2])
