"""Label maps: names against published lists, and the computed probabilities."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torchvision.datasets import Cityscapes
from torchvision.models.segmentation import DeepLabV3_ResNet50_Weights

from datamodules.cityscapes import CLASSES as CITYSCAPES
from datamodules.cityscapes import THIRTEEN
from datamodules.core.label_map import LabelMap, plain_name
from datamodules.matterport360 import CLASSES as MATTERPORT
from datamodules.stanford2d3ds.files import CLASSES as STANFORD
from datamodules.stanford2d3ds.files import EIGHT
from datamodules.structured3d import CLASSES as STRUCTURED3D
from datamodules.synpass import CLASSES as SYNPASS
from datamodules.synthia.reader import CLASSES as SYNTHIA
from datamodules.zind.layout import CLASSES as ZIND
from tangent_train.checkpoints.loaded import LoadedNetwork
from tangent_train.checkpoints.outputs import Groups
from tangent_train.errors import SettingError
from tangent_train.heads import ClassesHead
from tangent_train.inference.api import Unmapped, load_label_map, map_classes
from tests.inference.trained import TANGENT, trained_network

# ADE20K: objectInfo150.txt of the MIT Scene Parsing Benchmark; COCO-Stuff: labels.txt.
PUBLISHED: dict[str, list[str]] = {
    **json.loads(Path(__file__).with_name("published_classes.json").read_text()),
    "Cityscapes": [c.name for c in Cityscapes.classes if not c.ignore_in_eval],
    "SynPASS": list(SYNPASS),
    "Stanford2D3DS": list(STANFORD),
    "Structured3D": list(STRUCTURED3D),
    "Pascal VOC": DeepLabV3_ResNet50_Weights.DEFAULT.meta["categories"],
}
SHIPPED = {
    "ade20k_to_stanford2d3ds": ("ADE20K", 150, STANFORD),
    "ade20k_to_structured3d": ("ADE20K", 150, STRUCTURED3D),
    "ade20k_to_matterport360": ("ADE20K", 150, MATTERPORT),
    "stanford2d3ds_to_span8": ("Stanford2D3DS", 13, EIGHT),
    "structured3d_to_span8": ("Structured3D", 40, EIGHT),
    "ade20k_to_zind_layout": ("ADE20K", 150, ZIND),
    "coco_stuff_to_stanford2d3ds": ("COCO-Stuff", 182, STANFORD),
    "cityscapes_to_synthia": ("Cityscapes", 19, SYNTHIA),
    "voc_to_stanford2d3ds": ("Pascal VOC", 21, STANFORD),
    "ade20k_to_cityscapes": ("ADE20K", 150, CITYSCAPES),
    "cityscapes_to_densepass13": ("Cityscapes", 19, THIRTEEN),
    "synpass_to_densepass13": ("SynPASS", 22, THIRTEEN),
}


def _trained(names: Sequence[str], groups: Groups | None = None) -> LoadedNetwork:
    """A network whose scores are its images."""
    class_names = ("unknown", *names)
    return trained_network(TANGENT, module=nn.Identity(), class_names=class_names, groups=groups)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_map_names_published_classes(name: str) -> None:
    source, count, targets = SHIPPED[name]
    published = PUBLISHED[source]
    assert len(published) == count
    found = load_label_map(name)
    assert found.names == targets
    synonyms = {part.strip() for text in published for part in text.split(",")}
    synonyms |= {"dining table", "potted plant", "tv monitor"}  # VOC's, as others write them
    assert not found.labels.keys() - set(map(plain_name, synonyms))
    mapped = map_classes(_trained(published), found)
    for target, label in zip(targets, range(1, 255), strict=False):
        names = [key for key, of in found.labels.items() if of == label]
        assert bool(names) == bool(mapped.classes[target])
        firsts = {text.split(",")[0].strip() for text in mapped.classes[target]}
        assert set(map(plain_name, firsts)) <= set(names)


def test_names_are_compared_without_case_hyphens_and_further_synonyms() -> None:
    names = ["Swivel_Chair", "WINDOWPANE, window ", "floor-wood", "floor"]
    given = LabelMap.of({"seat": ["swivel chair"], "hole": ["window", "windowpane"],
                                 "ground": ["floor wood"]})  # fmt: skip
    mapped = map_classes(_trained(names), given)
    assert mapped.classes == {"seat": names[:1], "hole": names[1:2], "ground": names[2:3]}
    assert mapped.description.endswith(
        "; not in the network: window; unknown where they win: floor"
    )


@pytest.mark.parametrize("nothing", [None, [6]], ids=["all", "nothing"])
@pytest.mark.parametrize("unmapped", ["unknown", "never"])
def test_probabilities_of_a_class_add_up(unmapped: Unmapped, nothing: list[int] | None) -> None:
    """Labels and probabilities agree with NumPy."""
    names = ["bed", "wall", "painting", "floor", "sky", "tree"]
    groups = None if nothing is None else [*([k] for k in range(6)), nothing]
    given = LabelMap.of({"wall": ["painting", "wall"], "beam": ["rafter"],
                                 "floor": ["floor", "rug"], "rest": ["bed"]})  # fmt: skip
    trained = map_classes(_trained(names, groups), given, unmapped).loaded
    assert trained.class_names == ("unknown", "wall", "beam", "floor", "rest")
    scores = torch.randn(2, 6 + (nothing is not None), 16, 16, dtype=torch.float64)
    scores[0] *= 8
    found = trained.network(scores)
    exponents = np.exp(scores.numpy())
    sums = [exponents[:, [1, 2]].sum(1), 0 * exponents[:, 0], exponents[:, 3], exponents[:, 0]]
    blank = ([6] if nothing is not None else []) + ([4, 5] if unmapped == "unknown" else [])
    sums += [exponents[:, blank].sum(1)] if blank else []
    expected = np.stack(sums, 1) / np.sum(sums, 0)[:, None]
    np.testing.assert_allclose(torch.softmax(found, 1).numpy(), expected, atol=1e-8)
    best = expected.argmax(1)
    wanted = np.where(best == 4, 0, best + 1)
    assert (wanted == 0).any() == bool(blank)
    labels = ClassesHead(trained.class_names).labels_of(found.argmax(dim=1))
    np.testing.assert_array_equal(labels, wanted)


def test_a_class_without_scores_wins_in_no_mean_of_pixels() -> None:
    """Scores of pixels and images are averaged with weights that may be 0."""
    trained = map_classes(
        _trained(["a", "b"]), LabelMap.of({"none": [], "b": ["b"]}), "never"
    ).loaded
    found = trained.network(1e4 * torch.randn(64, 2, 1, 1))[..., 0, 0]
    weights = torch.rand(256, 64) * (torch.rand(256, 64) < 0.5)
    assert bool((weights @ found).argmax(1).bool().all())
    assert bool(found.isfinite().all())


def test_the_order_and_the_number_of_classes_can_be_those_of_data() -> None:
    given = LabelMap.of({"floor": ["floor"], "wall": ["wall"]})
    trained = map_classes(_trained(["wall", "floor"]), given, targets=("wall", "sofa", "floor"))
    assert trained.loaded.class_names == ("unknown", "wall", "sofa", "floor")
    assert [list(group) for group in trained.loaded.groups or ()] == [[0], [], [1]]
    with pytest.raises(SettingError, match="floor, wall; expected a map from wall to floor, sofa"):
        map_classes(_trained(["wall"]), given, targets=("floor", "sofa"))


def test_a_map_can_follow_a_map() -> None:
    """Scores of the innermost network, with its image size."""
    first = LabelMap.of({"indoor": ["bed", "wall"], "outdoor": ["sky"]})
    names = ["bed", "wall", "sky", "tree"]
    trained = replace(_trained(names, [[3], [2], [1], [0]]), fixed_size=(8, 8))
    once = map_classes(trained, first).loaded
    assert [list(group) for group in once.groups or ()] == [[3, 2], [1], [0]]
    twice = map_classes(once, LabelMap.of({"all": ["outdoor"]})).loaded
    assert [list(group) for group in twice.groups or ()] == [[1], [0, 3, 2]]
    assert twice.network(torch.randn(1, 4, 12, 20)).shape == (1, 2, 12, 20)
