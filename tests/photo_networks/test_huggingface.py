"""Networks of transformers: scores of a checkpoint equal those of the library."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tangent_train.errors import DataError, SettingError
from tangent_train.photo_networks import huggingface
from tests.photo_networks import huggingface_networks as networks


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a SegFormer, saved by transformers."""
    networks.saved(networks.segformer, tmp_path / "net")
    return tmp_path / "net"


def test_segformer_keeps_its_normalization(tmp_path: Path) -> None:
    """The processor has an unusual factor and normalization."""
    settings: dict[str, Any] = {
        "rescale_factor": 1 / 128,
        "image_mean": [0.4, 0.5, 0.6],
        "image_std": [0.2, 0.3, 0.4],
    }
    network, processor = networks.saved(networks.segformer, tmp_path, **settings)
    trained = networks.imported(tmp_path)
    assert trained.class_names == ("unknown", *networks.NAMES)
    assert (trained.image_size, trained.level) == ((64, 64), 6)
    expected = networks.own_scores(network, processor)
    scores = networks.imported_scores(trained)
    networks.assert_same(scores, expected)


@pytest.mark.parametrize(
    ("made", "shares"),
    [
        (networks.upernet, False),
        (networks.mobilevit, False),
        (networks.mask2former, True),
        (networks.eomt, True),
    ],
)
def test_scores_are_those_of_the_library(
    made: Callable[[], Any], shares: bool, tmp_path: Path
) -> None:
    """Scores of queries are logarithms of shares. MobileViT takes BGR images."""
    network, processor = networks.saved(made, tmp_path)
    scores = networks.imported_scores(networks.imported(tmp_path))
    expected = networks.own_scores(network, processor)
    networks.assert_same(scores.exp() if shares else scores, expected)


@pytest.mark.parametrize(
    ("made", "noise", "count"),
    [
        (networks.mask2former, 1.2, 2),
        (networks.eomt, 0.3, 1),
        (networks.maskformer, 0.22, 3),
        (networks.oneformer, 0.32, 3),
    ],
)
@torch.no_grad()
def test_objects_are_those_of_the_library(
    made: Callable[[], Any], noise: float, count: int, tmp_path: Path
) -> None:
    """OneFormer takes its task as text, for objects "panoptic"."""
    tokenizer = networks.tokenizer(tmp_path)
    network, processor = networks.saved(made, tmp_path, noise=noise)
    trained = networks.imported(tmp_path, things=networks.NAMES[1:])
    assert trained.things == networks.NAMES[1:]
    images = networks.normalized(trained)
    (found,) = trained.network(images)["segments"]
    given: dict[str, Any] = {"pixel_values": images}
    settings: dict[str, Any] = {"label_ids_to_fuse": {0}}
    if made is networks.oneformer:
        given |= networks.task_inputs(tokenizer, processor, "panoptic")
    returned = network(**given)
    if made is networks.eomt:
        returned["patch_offsets"], settings = None, {"stuff_classes": [0]}
    (expected,) = processor.post_process_panoptic_segmentation(
        returned, target_sizes=[(64, 64)], **settings
    )
    infos = sorted(expected["segments_info"], key=lambda info: float(info["score"]))
    assert len(infos) == len(found.classes) == count
    assert found.classes.tolist() == [info["label_id"] for info in infos]
    for number, info in enumerate(infos, 1):
        mask = expected["segmentation"] == info["id"]
        assert 0 < float(mask.float().mean()) < 1
        assert torch.equal(found.numbers == number, mask)
        assert round(float(found.scores[number - 1]), 6) == info["score"]


def test_oneformer_gets_the_semantic_task(tmp_path: Path) -> None:
    (tmp_path / "classes.json").write_text(
        json.dumps({k: {"name": name, "isthing": 0} for k, name in enumerate(networks.NAMES)})
    )
    settings: dict[str, Any] = {"repo_path": str(tmp_path), "class_info_file": "classes.json"}
    network, processor = networks.saved(lambda: networks.oneformer(**settings), tmp_path)
    with pytest.raises(DataError, match=r"no tokenizer\.json or vocab\.json; expected the"):
        networks.imported(tmp_path)
    task = networks.task_inputs(networks.tokenizer(tmp_path), processor, "semantic")
    scores = networks.imported_scores(networks.imported(tmp_path))
    expected = networks.own_scores(network, processor, **task)
    networks.assert_same(scores.exp(), expected)


def test_one_label_is_of_a_class_and_its_background(tmp_path: Path) -> None:
    """transformers trains such a network with a sigmoid."""

    def one_class() -> networks.Made:
        network, processor = networks.segformer()
        config = network.config.__class__(**network.config.to_dict() | {"num_labels": 1})
        return type(network)(config), processor

    network, processor = networks.saved(one_class, tmp_path)
    logits = networks.own_logits(network, processor)
    with torch.no_grad():
        network.decode_head.classifier.bias -= logits.mean()
    network.save_pretrained(tmp_path)
    logits = networks.own_logits(network, processor)
    trained = networks.imported(tmp_path)
    assert trained.class_names == ("unknown", "LABEL_0")
    scores = networks.imported_scores(trained)
    networks.assert_same(scores.softmax(dim=0)[:1], logits.sigmoid())
    assert 0.2 < float((logits > 0).float().mean()) < 0.8
    assert torch.equal(scores.argmax(dim=0) == 0, logits[0] > 0)


_PROCESSORS = (
    *("Segformer", "Beit", "MobileViT", "Eomt", "OneFormer", "EfficientNet"),
    *("ZoeDepth", "GLPN", "Tipsv2Dpt"),
)


@pytest.mark.parametrize("name", _PROCESSORS)
def test_an_image_processor_is_the_librarys_whatever_its_file_leaves_out(
    name: str, tmp_path: Path
) -> None:
    """Images of one color are normalized as by transformers."""
    kind = getattr(networks.transformers, f"{name}ImageProcessor")
    kind().save_pretrained(tmp_path)
    path = tmp_path / "preprocessor_config.json"
    whole = json.loads(path.read_text())
    types = {"image_processor_type": f"{name}ImageProcessor"}
    changes: list[dict[str, Any]] = [
        {},
        *({one: None} for one in whole if one not in types),
        dict.fromkeys(whole) | types,
        dict.fromkeys(whole) | {"feature_extractor_type": f"{name}FeatureExtractor"},
        {"image_processor_type": f"{name}ImageProcessorFast"},
        {"do_rescale": False},
        {"do_normalize": False},
        {"do_flip_channel_order": False},
        {"do_flip_channel_order": True, "do_normalize": True, "image_mean": [0.1, 0.2, 0.3]},
        {"rescale_factor": 1 / 128, "image_std": 0.3},
    ]
    color = np.array([200, 30, 90], np.uint8)
    photo = np.tile(color, (32, 32, 1))
    for change in changes:
        content = {n: v for n, v in (whole | change).items() if v is not None}
        path.write_text(json.dumps(content))
        processor = networks.transformers.AutoImageProcessor.from_pretrained(tmp_path)
        sizes = {
            n: False for n in ("do_resize", "do_center_crop", "do_pad") if hasattr(processor, n)
        }
        try:
            pixels = np.asarray(processor(photo, return_tensors="np", **sizes)["pixel_values"])
        except (TypeError, ValueError):  # e.g. a normalization without numbers
            with pytest.raises(DataError, match="no normalization in"):
                huggingface._processor(tmp_path, "segformer")
            continue
        expected = np.moveaxis(pixels.reshape(-1, *pixels.shape[-3:])[0], 0, -1)[16, 16]
        found = huggingface._processor(tmp_path, "segformer")
        normalized = (color / 255 - found["normalization"].mean) / found["normalization"].std
        normalized = normalized[::-1] if found["do_flip_channel_order"] else normalized
        np.testing.assert_allclose(normalized, expected, rtol=1e-4, atol=1e-4, err_msg=f"{change}")


def test_an_image_processor_without_a_type_is_that_of_the_network(folder: Path) -> None:
    expected = networks.imported(folder)
    networks.change_json(folder / "preprocessor_config.json", image_processor_type=None)
    found = networks.imported(folder)
    assert (found.normalization, found.image_size) == (expected.normalization, expected.image_size)
    networks.change_json(folder / "preprocessor_config.json", do_resize=False)
    imported = networks.imported(folder)
    assert (imported.image_size, imported.level) == ((512, 512), 9)


def test_float16_weights_are_stored_as_float32(folder: Path) -> None:
    weights = folder / "model.safetensors"
    save_file({n: t.half() for n, t in load_file(weights).items()}, weights, {"format": "pt"})
    tensors = networks.imported(folder).network.state_dict()
    assert {t.dtype for t in tensors.values() if t.is_floating_point()} == {torch.float32}


@pytest.mark.parametrize(
    ("file", "changes", "message"),
    [
        ("config.json", {"id2label": {"0": "wall", "2": "floor"}}, "id2label.*name of every score"),
        ("config.json", {"depths": [2, 1, 1, 1]}, "found other weights: no .*described in config"),
        ("config.json", {"hidden_act": "https://x.org/gelu"}, "config.json: found network.config"),
        ("preprocessor_config.json", {"image_std": [0, 1, 1]}, "no normalization in"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    file: str, changes: dict[str, Any], message: str, folder: Path
) -> None:
    networks.change_json(folder / file, **changes)
    with pytest.raises((DataError, SettingError), match=message):
        networks.imported(folder)


def test_missing_files_are_named(folder: Path, tmp_path: Path) -> None:
    weights = folder / "model.safetensors"
    weights.rename(folder / "pytorch_model.bin")
    with pytest.raises(DataError, match=r"found no model\.safetensors.*save_"):
        networks.imported(folder)
    (folder / "pytorch_model.bin").rename(weights)
    (folder / "preprocessor_config.json").rename(tmp_path / "elsewhere.json")
    with pytest.raises(DataError, match=r"preprocessor_config\.json: found .*image processor"):
        networks.imported(folder)
    nested = {"image_processor": json.loads((tmp_path / "elsewhere.json").read_text())}
    (folder / "processor_config.json").write_text(json.dumps(nested))
    assert networks.imported(folder).image_size == (64, 64)


def test_models_of_the_hub_are_fetched_without_code(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: dict[str, Any] = {}

    def fetch(name: str, *, allow_patterns: list[str]) -> str:
        requested[name] = allow_patterns
        return str(folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fetch)
    network = huggingface.load(model="someone/net", classes=None, normalization=None)
    assert tuple(network.score_names) == networks.NAMES
    (patterns,) = requested.values()
    assert not [p for p in patterns if p.endswith((".py", ".bin", "*"))]
